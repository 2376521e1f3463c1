"""The file of one view's frames: its layout, and functions to read it.

It is a NeXus HDF5 file with frames `[n, H, W]` uint16 and a table of fixed records. Both are contiguous, and
`coupole.storage.frame_file_creation` allocates them once. `coupole.storage.view_writer` then writes bytes directly
to their offsets. So the file is valid HDF5 at every moment, and a crash cannot break it. The record of a slot has
its state: free, a frame not yet proven, a proven shot with its checksum, or a proven shot whose pixels were
discarded (`coupole.storage.discarding`).
"""

from __future__ import annotations

import errno
import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from coupole.errors import StorageError
from coupole.intake.regular_file import open_regular
from coupole.plan.shot_id import MAX_CHARACTERS

FREE, STORED, PROVEN, DISCARDED = 0, 1, 2, 3

FRAME_DTYPE = np.dtype(
    [
        ("state", "<u2"),
        ("led", "<u2"),
        ("exposure_us", "<u4"),
        ("shot", f"S{MAX_CHARACTERS}"),
        ("burst", "<u4"),
        ("step", "<u4"),
        ("t_trigger_ns", "<u8"),
        ("frame_id", "<u8"),
        ("camera_ns", "<u8"),
        ("xxh3", "<u8"),
        ("board_temperature_dc", "<i2"),
        ("led_current_ma", "<u2"),
        ("status", "<u2"),
        ("pose", "<u2"),
    ]
)
"""Frame table: content of each slot. The states are 0 free, 1 stored but not proven, 2 proven, 3 proven and
discarded."""

POSE_DTYPE = np.dtype(
    [
        ("t_ns", "<u8"),
        ("joints_deg", "<f8", (6,)),
        ("base_from_flange", "<f8", (4, 4)),
        ("base_from_camera", "<f8", (4, 4)),
    ]
)
"""Measured poses. The `pose` of a frame is a row number in this table."""

SPARE_SLOTS = 32
"""Slots of a view's file for surplus frames, until their burst has been evaluated."""
PAGE = mmap.PAGESIZE
MAX_POSES = 256
PATTERNS = ("MONO", "RGGB", "BGGR", "GRBG", "GBRG")
_WRONG = (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, ArithmeticError, MemoryError)
"""Errors that h5py and NumPy raise for a damaged file, or for a file of another kind."""
DATA, FRAMES, POSES = (
    "entry/instrument/detector/data",
    "entry/instrument/detector/frames",
    "entry/instrument/robot/poses",
)


def checksum(pixels: NDArray[np.uint16]) -> int:
    """xxh3-64 of a frame's bytes."""
    return xxhash.xxh3_64_intdigest(pixels.data.cast("B"))


@dataclass(frozen=True)
class Layout:
    """Shape of the frames and offsets of frames and tables in the file, bytes."""

    frames: int
    height_px: int
    width_px: int
    data_offset: int
    """Offset of the frames; 0 if the file is archived."""
    table_offset: int
    poses_offset: int
    is_archived: bool
    """True if the frames are compressed by `coupole.storage.archive`; the file is then read-only."""
    is_packed: bool
    """True if two pixels are packed in three bytes (`coupole.storage.packing`, `lsb`)."""
    inode: int
    """Inode of the file; it changes when the file is archived."""

    @property
    def frame_bytes(self) -> int:
        """Size of a frame in the file."""
        pixels = self.height_px * self.width_px
        return pixels * 3 // 2 if self.is_packed else pixels * 2


@contextmanager
def open_view(path: Path) -> Iterator[h5py.File]:
    """Open a view's file for reading. Raises StorageError if h5py or the caller then finds a fault in it."""
    try:
        open_regular(path).close()
        with h5py.File(path, "r") as file:
            yield file
    except _WRONG as error:
        raise StorageError(f"{path}: not a view file of a run: {error}") from error


def read_layout(path: Path) -> Layout:
    """Return the layout of a view's file. Raises StorageError if the file is of another kind."""
    with open_view(path) as file:
        inode = os.fstat(file.id.get_vfd_handle()).st_ino
        data, frames, poses = file[DATA], file[FRAMES], file[POSES]
        is_packed = data.dtype == np.uint8
        slots, height_px, columns = data.shape
        if data.dtype not in (np.uint8, np.uint16) or frames.dtype != FRAME_DTYPE or poses.dtype != POSE_DTYPE:
            raise ValueError("pixels or tables have an unexpected type")
        if frames.shape != (slots,) or len(poses) > MAX_POSES:
            raise ValueError(f"{slots} frames, a table of {frames.shape}, {len(poses)} poses")
        return Layout(
            slots,
            height_px,
            columns * 2 // 3 if is_packed else columns,
            data.id.get_offset() or 0,
            frames.id.get_offset(),
            poses.id.get_offset(),
            is_archived=data.chunks is not None,
            is_packed=is_packed,
            inode=inode,
        )


def read_facts(path: Path) -> dict[str, Any]:
    """Return `pattern`, `black_dn` and `white_dn` of a view's frames. Raises StorageError."""
    with open_view(path) as file:
        detector = file["entry/instrument/detector"]
        facts = {
            "pattern": detector["bayer_pattern"][()].decode("ascii"),
            "black_dn": int(detector["black_level"][()]),
            "white_dn": int(detector["saturation_value"][()]),
        }
        if facts["pattern"] not in PATTERNS or not 0 <= facts["black_dn"] < facts["white_dn"] <= 65535:
            raise ValueError(f"impossible levels or colours: {facts}")
        return facts


def read_poses_and_attributes(path: Path) -> tuple[NDArray[np.void], dict[str, Any]]:
    """Return the table of poses, POSE_DTYPE, and the attributes of a view's file. Raises StorageError."""
    read_layout(path)
    with open_view(path) as file:
        return file[POSES][:], dict(file["entry"].attrs)


def read_frames(path: Path) -> NDArray[np.void]:
    """Return the frame table [slots], FRAME_DTYPE. Raises StorageError."""
    layout = read_layout(path)
    with path.open("rb") as file:
        file.seek(layout.table_offset)
        table = file.read(layout.frames * FRAME_DTYPE.itemsize)
    if len(table) != layout.frames * FRAME_DTYPE.itemsize:
        raise StorageError(f"{path}: ends within the table of its frames")
    return np.frombuffer(table, FRAME_DTYPE).copy()


def read_frame(path: Path, layout: Layout, slot: int) -> NDArray[np.uint16]:
    """Return the pixels [H, W] of one slot, DN, even if the file was archived after its layout was read.

    Raises StorageError if the frame cannot be read.
    """
    if layout.is_archived:
        return _read_archived_frame(path, slot)
    with path.open("rb") as file:
        if os.fstat(file.fileno()).st_ino == layout.inode:
            file.seek(layout.data_offset + slot * layout.frame_bytes)
            frame_bytes = file.read(layout.frame_bytes)
            if len(frame_bytes) != layout.frame_bytes:
                raise StorageError(f"{path}: ends within slot {slot}")
            return pixels_of(frame_bytes, layout)
    return read_frame(path, read_layout(path), slot)


def read_frame_into(path: Path, layout: Layout, slot: int, pixels: NDArray[np.uint16]) -> None:
    """Read a frame as `read_frame` does, into the caller's `pixels` [H, W], C order. The page cache is not used if
    the file system, the size of the frames and the memory's alignment (512 bytes) allow this. Raises
    StorageError."""
    if layout.is_archived or layout.is_packed or not _read_direct(path, layout, slot, pixels):
        pixels[:] = read_frame(path, layout, slot)


def _read_direct(path: Path, layout: Layout, slot: int, pixels: NDArray[np.uint16]) -> bool:
    """Tell whether the frame was read. It was not read if the file has been replaced, ends early, or cannot be
    read directly."""
    if layout.frame_bytes % PAGE or layout.data_offset % PAGE:
        return False
    try:
        fd = os.open(path, os.O_RDONLY | os.O_DIRECT)
    except OSError as error:
        if error.errno != errno.EINVAL:  # not supported by this file system
            raise StorageError(f"{path}: {error.strerror}") from error
        return False
    try:
        if os.fstat(fd).st_ino != layout.inode:
            return False
        memory = pixels.data.cast("B")
        return os.preadv(fd, [memory], layout.data_offset + slot * layout.frame_bytes) == layout.frame_bytes
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise StorageError(f"{path}: slot {slot}: {error.strerror}") from error
        return False
    finally:
        os.close(fd)


def pixels_of(frame_bytes: bytes | mmap.mmap, layout: Layout) -> NDArray[np.uint16]:
    """Return the pixels [H, W] of a frame, DN, from its bytes in a file that is not archived. The pixels are
    copied only if the frame is packed.
    """
    if layout.is_packed:
        from coupole.storage.packing import unpack12

        pixels = unpack12(np.frombuffer(frame_bytes, np.uint8))
    else:
        pixels = np.frombuffer(frame_bytes, np.uint16)
    return pixels.reshape(layout.height_px, layout.width_px)


def _read_archived_frame(path: Path, slot: int) -> NDArray[np.uint16]:
    import hdf5plugin  # noqa: F401  # registers the filter

    with open_view(path) as file:
        pixels: NDArray[np.uint16] = file[DATA][slot]
        return pixels

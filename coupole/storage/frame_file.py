"""Frames on disk: one NeXus HDF5 file for each view, written at the speed of the disk.

The file is laid out once, by h5py: frames `[n, H, W]` uint16 and a table of fixed records, both contiguous and
allocated. From then on bytes are written straight to their offsets (O_DIRECT where the file system and the
frame's size allow it), so the file is valid HDF5 at every moment and a crash cannot break it. A slot's record
says what the slot holds: nothing, a frame not yet proven, or a proven shot with its checksum.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from coupole.devices import ArmState, FrameFormat
from coupole.errors import DiskFull, StorageError
from coupole.geometry import Transform

FREE, STORED, PROVEN = 0, 1, 2

FRAME_DTYPE = np.dtype(
    [
        ("state", "<u2"),
        ("led", "<u2"),
        ("exposure_us", "<u4"),
        ("shot", "S80"),
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
"""Frame table: what each slot holds (state 0 free, 1 stored but not proven, 2 proven)."""

POSE_DTYPE = np.dtype(
    [
        ("t_ns", "<u8"),
        ("joints_deg", "<f8", (6,)),
        ("base_from_flange", "<f8", (4, 4)),
        ("base_from_camera", "<f8", (4, 4)),
    ]
)
"""Measured poses; a frame's `pose` says which was in force."""

PAGE = mmap.PAGESIZE
WRITERS = 3
"""Threads that write frames: more keep a fast disk no busier (`tools/bench.py store`)."""
_SPEED_BLOCK_BYTES = 8 * 2**20
_SPEED_LEAST_BLOCKS, _SPEED_MOST_BLOCKS, _SPEED_FRAMES = 8, 64, 20
MAX_POSES = 256
DATA, FRAMES, POSES = (
    "entry/instrument/detector/data",
    "entry/instrument/detector/frames",
    "entry/instrument/robot/poses",
)


def checksum(pixels: NDArray[np.uint16]) -> int:
    """xxh3-64 of a frame's bytes."""
    return xxhash.xxh3_64_intdigest(pixels.data.cast("B"))


def _storage_error(path: Path, error: OSError) -> StorageError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFull(f"{path}: the disk is full. Free space on it, then resume the run.")
    return StorageError(f"{path}: {error.strerror or error}. Check the disk, then resume the run.")


@dataclass(frozen=True)
class Layout:
    """Where things lie in the file, bytes."""

    frames: int
    height_px: int
    width_px: int
    data_offset: int
    """0 if the file is archived."""
    table_offset: int
    poses_offset: int
    archived: bool
    """True if the frames are compressed, as `coupole.storage.archive` leaves them; then the file is only read."""
    packed: bool
    """True if two pixels lie in three bytes (`coupole.storage.packing`, `lsb`)."""
    inode: int
    """Of the file: another one has come to its place if it was archived since."""

    @property
    def frame_bytes(self) -> int:
        """Of a frame in the file."""
        pixels = self.height_px * self.width_px
        return pixels * 3 // 2 if self.packed else pixels * 2


Collections = Mapping[str, Mapping[str, NDArray[np.generic]]]
"""Arrays by name, by name of the group in the entry that holds them (NXcollection)."""


def create(
    path: Path,
    slots: int,
    frame_format: FrameFormat,
    metadata: dict[str, Any],
    collections: Collections | None = None,
    *,
    packed: bool = False,
) -> None:
    """Lay out a view's file with `slots` slots, all free, and its space allocated; frames of up to 12 bits may be
    `packed`.

    `metadata`: `title`, `sample`, `simulated`, `pixel_pitch_um` and whatever else is to stand in the entry's
    attributes. Raises DiskFull if there is no room for all of it.
    """
    partial = path.with_suffix(".part")
    try:
        with h5py.File(
            partial, "w", alignment_threshold=PAGE, alignment_interval=PAGE, libver=("v108", "v110")
        ) as file:
            _describe(file, slots, frame_format, metadata, packed=packed)
            for name, arrays in (collections or {}).items():
                collection = _group(file["entry"], name, "NXcollection")
                for key, values in arrays.items():
                    collection[key] = values
        with partial.open("r+b") as file_on_disk:
            os.posix_fallocate(file_on_disk.fileno(), 0, partial.stat().st_size)
            os.fsync(file_on_disk.fileno())
        partial.rename(path)
        folder = os.open(path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise _storage_error(path, error) from error


def _describe(
    file: h5py.File, slots: int, frame_format: FrameFormat, metadata: dict[str, Any], *, packed: bool
) -> None:
    file.attrs["default"] = "entry"
    entry = _group(file, "entry", "NXentry", default="data")
    entry["title"] = metadata["title"]
    for key, value in metadata.items():
        entry.attrs[key] = value
    instrument = _group(entry, "instrument", "NXinstrument")
    instrument["name"] = "La Coupole"
    detector = _group(instrument, "detector", "NXdetector")
    columns, dtype = (frame_format.width_px * 3 // 2, "u1") if packed else (frame_format.width_px, "<u2")
    shape = (slots, frame_format.height_px, columns)
    data = _contiguous(detector, "data", shape, np.dtype(dtype), fill=False)
    if packed:
        data.attrs["packing"] = "three bytes hold two pixels a, b: a[7:0], b[3:0] a[11:8], b[11:4] (GenICam 12p)"
    data.attrs["units"] = "DN"
    data.attrs["long_name"] = "raw frames, one a slot; `frames` says what each slot holds"
    _contiguous(detector, "frames", (slots,), FRAME_DTYPE, fill=True)
    detector["bit_depth_readout"] = frame_format.bit_depth
    detector["saturation_value"] = frame_format.white_dn
    detector["black_level"] = frame_format.black_dn
    detector["bayer_pattern"] = frame_format.bayer_pattern
    for axis in ("x_pixel_size", "y_pixel_size"):
        detector[axis] = float(metadata["pixel_pitch_um"])
        detector[axis].attrs["units"] = "um"
    robot = _group(instrument, "robot", "NXpositioner")
    _contiguous(robot, "poses", (MAX_POSES,), POSE_DTYPE, fill=True)
    sample = _group(entry, "sample", "NXsample")
    sample["name"] = metadata["sample"]
    shown = _group(entry, "data", "NXdata", signal="data")
    shown["data"] = h5py.SoftLink(f"/{DATA}")


def _group(parent: h5py.Group, name: str, nx_class: str, **attributes: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    for key, value in attributes.items():
        group.attrs[key] = value
    return group


def _contiguous(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], *, fill: bool
) -> h5py.Dataset:
    """A contiguous dataset that is allocated at once, so that its offset in the file is known."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_ALLOC if fill else h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(group.id, name.encode(), h5py.h5t.py_create(dtype, logical=True), space, dcpl=properties)
    return group[name]


def read_layout(path: Path) -> Layout:
    """Where frames and tables lie in a view's file. Raises StorageError if it is not such a file."""
    try:
        inode = path.stat().st_ino  # before the file is opened: if it is replaced now, `read_frame` sees it
        with h5py.File(path, "r") as file:
            data, frames, poses = file[DATA], file[FRAMES], file[POSES]
            packed = data.dtype == np.uint8
            slots, height_px, columns = data.shape
            return Layout(
                slots,
                height_px,
                columns * 2 // 3 if packed else columns,
                data.id.get_offset() or 0,
                frames.id.get_offset(),
                poses.id.get_offset(),
                archived=data.chunks is not None,
                packed=packed,
                inode=inode,
            )
    except (OSError, KeyError) as error:
        raise StorageError(f"{path}: not a view file of a run: {error}") from error


def read_facts(path: Path) -> dict[str, Any]:
    """`pattern`, `black_dn` and `white_dn` of a view's frames."""
    with h5py.File(path, "r") as file:
        detector = file["entry/instrument/detector"]
        return {
            "pattern": detector["bayer_pattern"][()].decode(),
            "black_dn": int(detector["black_level"][()]),
            "white_dn": int(detector["saturation_value"][()]),
        }


def read_frames(path: Path) -> NDArray[np.void]:
    """The frame table [slots], FRAME_DTYPE."""
    layout = read_layout(path)
    with path.open("rb") as file:
        file.seek(layout.table_offset)
        return np.frombuffer(file.read(layout.frames * FRAME_DTYPE.itemsize), FRAME_DTYPE).copy()


def read_frame(path: Path, layout: Layout, slot: int) -> NDArray[np.uint16]:
    """Pixels [H, W] of one slot, DN, also if the file was archived since its layout was read.

    Raises StorageError if an archived frame cannot be read.
    """
    if layout.archived:
        return _read_archived_frame(path, slot)
    with path.open("rb") as file:
        if os.fstat(file.fileno()).st_ino == layout.inode:
            file.seek(layout.data_offset + slot * layout.frame_bytes)
            return pixels_of(file.read(layout.frame_bytes), layout)
    return read_frame(path, read_layout(path), slot)


def pixels_of(stored: bytes | mmap.mmap, layout: Layout) -> NDArray[np.uint16]:
    """Pixels [H, W] of a frame as it lies in a file that is not archived, DN; not copied unless it is packed."""
    if layout.packed:
        from coupole.storage.packing import unpack12

        pixels = unpack12(np.frombuffer(stored, np.uint8))
    else:
        pixels = np.frombuffer(stored, np.uint16)
    return pixels.reshape(layout.height_px, layout.width_px)


def _read_archived_frame(path: Path, slot: int) -> NDArray[np.uint16]:
    import hdf5plugin  # noqa: F401  # registers the filter

    try:
        with h5py.File(path, "r") as file:
            pixels: NDArray[np.uint16] = file[DATA][slot]
            return pixels
    except OSError as error:
        raise StorageError(f"{path}: slot {slot} cannot be read: {error}") from error


class ViewWriter:
    """Writes one view's file. `put` may be called from several threads, everything else from one (`sync` from
    another than the rest)."""

    def __init__(self, path: Path, proven_slots: dict[str, int]) -> None:
        """Open a file that `create` made. `proven_slots` (shot id to slot) are kept; all other slots are free.
        Raises StorageError if the file was archived."""
        self.path = path
        self._layout = read_layout(path)
        if self._layout.archived:
            raise StorageError(
                f"{path}: is archived, so nothing is written into it any more. Only complete views are archived: "
                "see with `coupole verify` whether the journal lost lines."
            )
        self._table = read_frames(path)
        self._lock = threading.Lock()
        taken = set(proven_slots.values())
        self._free = deque(slot for slot in range(self._layout.frames) if slot not in taken)
        self._packed: queue.SimpleQueue[mmap.mmap] = queue.SimpleQueue()
        """Memory to pack frames in, page-aligned as direct writing asks."""
        if self._layout.packed:
            from coupole.storage.packing import pack12

            self._pack12 = pack12
            pack12(np.zeros(2, np.uint16))  # compiled now, not in the first burst
        self._changed: set[int] = set()
        """Slots whose record in the file is not up to date."""
        self._poses = 0
        self.direct = False
        try:
            self._plain_fd = os.open(path, os.O_RDWR)
            self._fd = self._plain_fd
            if self._layout.frame_bytes % PAGE == 0 and self._layout.data_offset % PAGE == 0:
                self._open_direct()
        except OSError as error:
            raise _storage_error(path, error) from error
        self._poses = int(np.count_nonzero(self._read_poses()["t_ns"]))
        for slot in self._free:
            if self._table[slot]["state"] != FREE:
                self.free(slot, give_back=False)

    def _open_direct(self) -> None:
        try:
            self._fd = os.open(self.path, os.O_WRONLY | os.O_DIRECT)
            self.direct = True
        except OSError as error:
            if error.errno != errno.EINVAL:  # this file system cannot: stay with the page cache
                raise

    def _read_poses(self) -> NDArray[np.void]:
        data = os.pread(self._plain_fd, MAX_POSES * POSE_DTYPE.itemsize, self._layout.poses_offset)
        return np.frombuffer(data, POSE_DTYPE)

    @property
    def free_slots(self) -> int:
        return len(self._free)

    def add_pose(self, arm: ArmState, base_from_camera: Transform) -> int:
        """Note a measured pose; returns the number that frames refer to it by."""
        if self._poses == MAX_POSES:
            raise StorageError(f"{self.path}: more than {MAX_POSES} measured poses in one view")
        record = np.zeros(1, POSE_DTYPE)
        record["t_ns"], record["joints_deg"] = max(1, arm.t_ns), arm.joints_deg
        record["base_from_flange"], record["base_from_camera"] = arm.base_from_flange, base_from_camera
        self._write(self._plain_fd, record.tobytes(), self._layout.poses_offset + self._poses * record.itemsize)
        self._poses += 1
        return self._poses - 1

    def put(self, pixels: NDArray[np.uint16], *, frame_id: int, camera_ns: int, exposure_us: int) -> int:
        """Write a frame into a free slot and say in its record that it is there, unproven; returns the slot."""
        try:
            with self._lock:
                slot = self._free.popleft()
        except IndexError:
            raise StorageError(
                f"{self.path}: no slot is free: more frames came than the view's bursts can have made. "
                "Look for a trigger line that bounces."
            ) from None
        record = np.zeros((), FRAME_DTYPE)
        record["state"], record["frame_id"], record["camera_ns"] = STORED, frame_id, camera_ns
        record["exposure_us"], record["xxh3"] = exposure_us, checksum(pixels)
        offset = self._layout.data_offset + slot * self._layout.frame_bytes
        with self._as_stored(pixels) as data:
            self._write(self._fd, data, offset)
        self._note(slot, record)
        return slot

    @contextlib.contextmanager
    def _as_stored(self, pixels: NDArray[np.uint16]) -> Iterator[memoryview]:
        """A frame's bytes as they are to lie in the file, while the context lasts."""
        if not self._layout.packed:
            yield pixels.data.cast("B")
            return
        try:
            memory = self._packed.get_nowait()
        except queue.Empty:
            memory = mmap.mmap(-1, self._layout.frame_bytes)
        try:
            yield self._pack12(pixels, out=np.frombuffer(memory, np.uint8)).data
        except ValueError as error:
            raise StorageError(
                f"{self.path}: a frame cannot be packed: {error}. Store `uint16` in the rig."
            ) from None
        finally:
            self._packed.put(memory)

    def frame_id(self, slot: int) -> int:
        """The camera's id of the frame in a slot."""
        return int(self._table[slot]["frame_id"])

    def prove(self, slot: int, shot: str, **fields: Any) -> int:
        """Say that a slot holds a proven shot; returns the frame's checksum. It counts after `sync()`."""
        record = self._table[slot].copy()
        record["shot"] = shot.encode()
        for name, value in fields.items():
            record[name] = value
        record["state"] = PROVEN
        self._note(slot, record)
        return int(record["xxh3"])

    def free(self, slot: int, *, give_back: bool = True) -> None:
        """A slot's frame is not wanted: it may be overwritten."""
        self._note(slot, np.zeros((), FRAME_DTYPE))
        if give_back:
            with self._lock:
                self._free.append(slot)

    def _note(self, slot: int, record: NDArray[np.void] | np.void) -> None:
        """Change a slot's record. It is written by the next `sync()`, with others: a small write beside each large
        one would cost a tenth of the disk's speed (they wait for each other in the file system)."""
        with self._lock:
            self._table[slot] = record
            self._changed.add(slot)

    def _write_table(self) -> None:
        with self._lock:
            slots = np.array(sorted(self._changed), np.int64)
            runs = np.split(slots, np.flatnonzero(np.diff(slots) > 1) + 1) if len(slots) else []
            pieces = [(int(run[0]), self._table[run[0] : run[-1] + 1].tobytes()) for run in runs]
            self._changed.clear()
        for first, data in pieces:
            self._write(self._plain_fd, data, self._layout.table_offset + first * FRAME_DTYPE.itemsize)

    def _write(self, fd: int, data: bytes | memoryview, offset: int) -> None:
        view = memoryview(data)
        try:
            while view:
                written = os.pwrite(fd, view, offset)
                view, offset = view[written:], offset + written
        except OSError as error:
            raise _storage_error(self.path, error) from error

    def sync(self) -> None:
        """All that was put, proven and freed is on disk when this returns."""
        self._write_table()
        try:
            os.fdatasync(self._plain_fd)
        except OSError as error:
            raise _storage_error(self.path, error) from error

    def close(self) -> None:
        """Give the file back; what was not synced is written, but need not last."""
        with contextlib.suppress(StorageError):
            self._write_table()
        if self._fd != self._plain_fd:
            os.close(self._fd)
        os.close(self._plain_fd)


def measure_write_speed(folder: Path, *, frame_bytes: int = 0) -> float:
    """Bytes per second that a folder's disk takes, written as frames are: O_DIRECT where possible, several at a
    time, into space that was allocated before, synced. Large frames are measured longer, for they need it."""
    blocks = min(max(_SPEED_LEAST_BLOCKS, _SPEED_FRAMES * frame_bytes // _SPEED_BLOCK_BYTES), _SPEED_MOST_BLOCKS)
    total_bytes = blocks * _SPEED_BLOCK_BYTES
    path = folder / f".speed-{os.getpid()}"
    block = mmap.mmap(-1, _SPEED_BLOCK_BYTES)
    block.write(os.urandom(_SPEED_BLOCK_BYTES))
    try:
        try:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_DIRECT, 0o600)
        except OSError:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)
        try:
            os.posix_fallocate(fd, 0, total_bytes)
            with ThreadPoolExecutor(WRITERS) as pool:
                start = time.perf_counter()
                for written in pool.map(
                    lambda offset: os.pwrite(fd, block, offset), range(0, total_bytes, _SPEED_BLOCK_BYTES)
                ):
                    if written < _SPEED_BLOCK_BYTES:
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fdatasync(fd)
                return total_bytes / (time.perf_counter() - start)
        finally:
            os.close(fd)
            path.unlink()
    except OSError as error:
        raise _storage_error(folder, error) from error

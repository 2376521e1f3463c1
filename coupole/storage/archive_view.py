"""Compresses the file of one view without loss, reads it back, and only then replaces the original.

The frames of `NAME.h5` are compressed into `NAME.archive`. This file is synced, read back from the disk through
HDF5 as any reader would, and compared with the frame table and the journal. Then it is renamed to `NAME.h5`. So at
every moment a complete file has the view's name, and archiving can be repeated after a crash.

Only proven frames are kept. Any other slot is free in the archive, or belongs to a frame that was discarded
before. It has no stored pixels; they read as 65535.
"""

from __future__ import annotations

import errno
import mmap
import os
import queue
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.errors import ChecksumMismatch, DiskFull, StorageError
from coupole.storage import bitshuffle, frame_file
from coupole.storage.bitshuffle import Codec
from coupole.storage.durable import sync_folder
from coupole.storage.hdf5_file import hdf5_file
from coupole.storage.journal_events import FrameProven
from coupole.storage.line_file import utc_now

Progress = Callable[[str, int, int], None]
"""Takes the current work (`top: compress`), the number of frames done, and their total."""
Tiles = list[tuple[tuple[int, int], bytes]]


@dataclass(frozen=True)
class ArchivedView:
    """Figures of a view that was archived."""

    view: str
    frames: int
    pixel_bytes: int
    """Bytes of its frames, uncompressed."""
    stored_bytes: int
    """Bytes of its frames in the archive."""
    freed_bytes: int
    """Bytes that are free on the disk again; negative if the original is kept."""
    compress_s: float
    read_back_s: float

    @property
    def ratio(self) -> float:
        return self.pixel_bytes / self.stored_bytes

    def figures(self) -> dict[str, Any]:
        """Return the view's part of `--json`: sizes in bytes, speeds in MB/s of uncompressed frames."""
        return {
            "view": self.view,
            "frames": self.frames,
            "bytes": self.pixel_bytes,
            "stored_bytes": self.stored_bytes,
            "ratio": round(self.ratio, 4),
            "compress_mb_s": round(self.pixel_bytes / self.compress_s / 1e6, 1),
            "read_back_mb_s": round(self.pixel_bytes / self.read_back_s / 1e6, 1),
            "freed_bytes": self.freed_bytes,
        }


def archive_view(
    path: Path, proven: Iterable[FrameProven], codec: Codec, progress: Progress, *, keep_in: Path | None = None
) -> ArchivedView:
    """Archive one view's file with its frames `proven`; the original is kept in the folder `keep_in`, if given.

    Raises ChecksumMismatch, DiskFull or StorageError; the file is then unchanged.
    """
    partial = path.with_suffix(".archive")
    frames = sorted(proven, key=lambda frame: frame.index)
    layout, before_bytes = frame_file.read_layout(path), _bytes_on_disk(path)
    _check_records(path, frame_file.read_frames(path), frames)
    started_s = time.perf_counter()
    try:
        with _storage_errors(path):
            stored_bytes = _write(path, partial, frames, codec, progress)
            written_s = time.perf_counter()
            _read_back(path, partial, frames, progress)
            read_s = time.perf_counter()
            _replace(path, partial, keep_in)
    finally:
        partial.unlink(missing_ok=True)
    return ArchivedView(
        view=path.stem,
        frames=len(frames),
        pixel_bytes=len(frames) * layout.height_px * layout.width_px * 2,
        stored_bytes=stored_bytes,
        freed_bytes=(0 if keep_in else before_bytes) - _bytes_on_disk(path),
        compress_s=written_s - started_s,
        read_back_s=read_s - written_s,
    )


def _bytes_on_disk(path: Path) -> int:
    return path.stat().st_blocks * 512


@contextmanager
def _storage_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFull(
                f"{path}: the disk is full. The view is unchanged; free some space, then archive again."
            ) from error
        raise StorageError(
            f"{path}: {error.strerror or error}. The view is unchanged; check the disk, then archive again."
        ) from error


def _check_records(path: Path, table: NDArray[np.void], frames: list[FrameProven]) -> None:
    """Raise unless the file's table agrees with the journal about every frame."""
    for frame in frames:
        claims = (frame_file.PROVEN, str(frame.shot).encode(), int(frame.xxh3, 16))
        if frame.index >= len(table) or table[frame.index][["state", "shot", "xxh3"]].item() != claims:
            raise ChecksumMismatch(
                f"{path}: slot {frame.index} should be recorded as {frame.shot}, as the journal says. "
                "`coupole verify` lists all that is wrong; nothing was changed."
            )


# -- writing ----------------------------------------------------------------------------------------------


def _write(path: Path, partial: Path, frames: list[FrameProven], codec: Codec, progress: Progress) -> int:
    """Compress the frames of `path` into a new synced file `partial`; return the number of bytes that they need
    there."""
    layout, workers = (
        frame_file.read_layout(path),
        (os.cpu_count() or 1) + 1,
    )  # one more, as some always wait for the disk
    tile = bitshuffle.tile_shape(layout.height_px, layout.width_px)
    with (
        _Source(path, layout, workers) as source,
        h5py.File(path, "r") as before,
        hdf5_file(partial, "w", libver=("v108", "v110")) as after,
        ThreadPoolExecutor(workers, "archive") as pool,
    ):
        shape = (layout.frames, layout.height_px, layout.width_px)
        try:
            data = _copy_all_but_frames(before, after, shape, tile, codec, {frame.index for frame in frames})
        except (LookupError, RuntimeError, TypeError, ValueError) as error:  # h5py's; a full disk is an OSError
            raise StorageError(f"{path}: is damaged: {error}") from error

        def compress(frame: FrameProven) -> Tiles:
            with source.frame(frame) as pixels:
                return list(bitshuffle.compressed_tiles(pixels, tile, codec))

        compressed_frames = _in_order(pool, compress, frames, ahead=2 * workers)
        for count, (frame, tiles) in enumerate(compressed_frames, start=1):
            for (row, column), tile_bytes in tiles:
                data.id.write_direct_chunk((frame.index, row, column), tile_bytes)
            after.raise_error()
            progress(f"{path.stem}: compress", count, len(frames))
        stored_bytes = int(data.id.get_storage_size())
    with partial.open("r+b") as on_disk:
        os.fsync(on_disk.fileno())
    return stored_bytes


def _copy_all_but_frames(
    before: h5py.File,
    after: h5py.File,
    shape: tuple[int, int, int],
    tile: tuple[int, int],
    codec: Codec,
    proven_slots: set[int],
) -> h5py.Dataset:
    """Copy groups, tables, values, links and attributes unchanged. Return the dataset of the frames, which is
    still empty."""
    frames = before[frame_file.DATA]
    pending = [(before["/"], after["/"])]
    while pending:
        old, new = pending.pop()
        _copy_attributes(old, new)
        for name in old:
            link = old.get(name, getlink=True)
            if isinstance(link, h5py.SoftLink):
                new[name] = h5py.SoftLink(link.path)
            elif isinstance(old[name], h5py.Group):
                pending.append((old[name], new.create_group(name)))
            elif old[name].name != frames.name:
                old.copy(name, new)
    data = after.create_dataset(
        frame_file.DATA, shape, "<u2", chunks=(1, *tile), fillvalue=bitshuffle.FILL_DN, **codec.filter
    )
    _copy_attributes(frames, data)
    data.attrs.pop("packing", None)
    data.attrs["archived"] = f"{utc_now()} by coupole {coupole.__version__}, bitshuffle and {codec.name}"
    data.attrs["not_stored"] = f"slots without a proven frame have no pixels and read as {bitshuffle.FILL_DN}"
    table = after[frame_file.FRAMES]
    records = table[:]
    is_kept = records["state"] == frame_file.DISCARDED
    is_kept[list(proven_slots)] = True
    records[~is_kept] = np.zeros((), frame_file.FRAME_DTYPE)
    table[:] = records
    return data


def _copy_attributes(old: h5py.HLObject, new: h5py.HLObject) -> None:
    for name, value in old.attrs.items():
        new.attrs[name] = value


def _in_order(
    pool: ThreadPoolExecutor, work: Callable[[FrameProven], Tiles], frames: list[FrameProven], ahead: int
) -> Iterator[tuple[FrameProven, Tiles]]:
    """Yield each frame with the result of `work`. The pool is at most `ahead` frames ahead, which limits the
    memory."""
    pending: deque[tuple[FrameProven, Future[Tiles]]] = deque()
    for frame in frames:
        pending.append((frame, pool.submit(work, frame)))
        if len(pending) > ahead:
            first, future = pending.popleft()
            yield first, future.result()
    for first, future in pending:
        yield first, future.result()


class _Source:
    """Stored frames of a view's file, read into separate memory. If possible, the page cache is not used: this
    takes a tenth of the processor's time."""

    def __init__(self, path: Path, layout: frame_file.Layout, threads: int) -> None:
        self._path, self._layout = path, layout
        direct = layout.frame_bytes % frame_file.PAGE == 0 and layout.data_offset % frame_file.PAGE == 0
        self._fd = _open_direct(path) if direct else os.open(path, os.O_RDONLY)
        self._spare: queue.SimpleQueue[mmap.mmap] = queue.SimpleQueue()
        for _ in range(threads):
            self._spare.put(mmap.mmap(-1, layout.frame_bytes))

    @contextmanager
    def frame(self, frame: FrameProven) -> Iterator[NDArray[np.uint16]]:
        """Give the pixels [H, W] while the context lasts. Raises ChecksumMismatch if they differ from the proven
        ones."""
        memory = self._spare.get()
        try:
            offset = self._layout.data_offset + frame.index * self._layout.frame_bytes
            read_bytes = os.preadv(self._fd, [memory], offset)
            pixels = frame_file.pixels_of(memory, self._layout)
            if read_bytes != self._layout.frame_bytes or f"{frame_file.checksum(pixels):016x}" != frame.xxh3:
                raise ChecksumMismatch(
                    f"{self._path}: {frame.shot} differs from what was proven. `coupole verify` lists all that is "
                    "wrong; nothing was changed."
                )
            yield pixels
        finally:
            self._spare.put(memory)

    def __enter__(self) -> _Source:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)


def _open_direct(path: Path) -> int:
    try:
        return os.open(path, os.O_RDONLY | os.O_DIRECT)
    except OSError as error:
        if error.errno != errno.EINVAL:  # not supported by this file system: use the page cache
            raise
        return os.open(path, os.O_RDONLY)


# -- reading back and replacing ---------------------------------------------------------------------------


def _read_back(path: Path, partial: Path, frames: list[FrameProven], progress: Progress) -> None:
    """Compare each frame and record of the new file, read from the disk through HDF5, as any reader does."""
    import hdf5plugin  # noqa: F401  # registers the filter

    with partial.open("rb") as on_disk:
        os.posix_fadvise(on_disk.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    with h5py.File(path, "r") as before, h5py.File(partial, "r") as after:
        slots = [frame.index for frame in frames]
        same = before[frame_file.FRAMES][:][slots].tobytes() == after[frame_file.FRAMES][:][slots].tobytes()
        if not same or before[frame_file.POSES][:].tobytes() != after[frame_file.POSES][:].tobytes():
            raise _not_the_same(path, "a table")
        data = after[frame_file.DATA]
        pixels = np.empty(data.shape[1:], data.dtype)
        for count, frame in enumerate(frames, start=1):
            data.read_direct(pixels, np.s_[frame.index])
            if f"{frame_file.checksum(pixels):016x}" != frame.xxh3:
                raise _not_the_same(path, str(frame.shot))
            progress(f"{path.stem}: read back", count, len(frames))


def _not_the_same(path: Path, part: str) -> ChecksumMismatch:
    return ChecksumMismatch(
        f"{path}: {part} differs when read back from the archive. The view is unchanged; check disk and "
        "memory of this machine, then archive again."
    )


def _replace(path: Path, partial: Path, keep_in: Path | None) -> None:
    if keep_in is not None:
        keep_in.mkdir(exist_ok=True)
        kept_path = keep_in / path.name
        is_linked = kept_path.exists() and kept_path.samefile(path)  # by an interrupted call
        if not is_linked:
            os.link(path, kept_path)
        sync_folder(keep_in)
        sync_folder(keep_in.parent)
    partial.rename(path)
    sync_folder(path.parent)

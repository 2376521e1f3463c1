"""Writes frames into the file of one view at the speed of the disk. It uses O_DIRECT if the file system and the
size of the frames allow this."""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import queue
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import ArmState
from coupole.errors import StorageError
from coupole.geometry import Transform
from coupole.storage.disk_errors import disk_error
from coupole.storage.frame_file import (
    FRAME_DTYPE,
    FREE,
    MAX_POSES,
    PAGE,
    POSE_DTYPE,
    PROVEN,
    STORED,
    checksum,
    read_frames,
    read_layout,
)

WRITERS = 3
"""Threads that write frames: more do not make a fast disk faster (`tools/bench.py store`)."""


class ViewWriter:
    """Writes one view's file. Several threads may call `store`. One thread calls all other methods; `sync` may be
    called from another thread."""

    def __init__(self, path: Path, proven_slots: dict[str, int]) -> None:
        """Open a file that `create` made. `proven_slots` (shot id to slot) are kept; all other slots are free.
        Raises StorageError if the file was archived."""
        self.path = path
        self._layout = read_layout(path)
        if self._layout.is_archived:
            raise StorageError(
                f"{path}: is archived, so nothing can be written into it. Only complete views are archived: "
                "check with `coupole verify` whether the journal lost lines."
            )
        self._table = read_frames(path)
        self._lock = threading.Lock()
        taken_slots = set(proven_slots.values())
        self._free = deque(slot for slot in range(self._layout.frames) if slot not in taken_slots)
        self._packed: queue.SimpleQueue[mmap.mmap] = queue.SimpleQueue()
        """Memory for packing frames, page-aligned as direct writing requires."""
        if self._layout.is_packed:
            from coupole.storage.packing import pack12

            self._pack12 = pack12
            pack12(np.zeros(2, np.uint16))  # compiled now, not in the first burst
        self._changed: set[int] = set()
        """Slots whose record in the file is not up to date yet."""
        self._poses = 0
        self.direct = False
        try:
            self._plain_fd = os.open(path, os.O_RDWR)
            self._fd = self._plain_fd
            if self._layout.frame_bytes % PAGE == 0 and self._layout.data_offset % PAGE == 0:
                self._open_direct()
        except OSError as error:
            raise disk_error(path, error) from error
        self._size_bytes = os.fstat(self._plain_fd).st_size
        self._poses = int(np.count_nonzero(self._read_poses()["t_ns"]))
        for slot in self._free:
            if self._table[slot]["state"] != FREE:
                self.free(slot, give_back=False)

    def _open_direct(self) -> None:
        try:
            self._fd = os.open(self.path, os.O_WRONLY | os.O_DIRECT)
            self.direct = True
        except OSError as error:
            if error.errno != errno.EINVAL:  # not supported by this file system: use the page cache
                raise

    def _read_poses(self) -> NDArray[np.void]:
        data = os.pread(self._plain_fd, MAX_POSES * POSE_DTYPE.itemsize, self._layout.poses_offset)
        return np.frombuffer(data, POSE_DTYPE)

    def add_pose(self, arm: ArmState, base_from_camera: Transform) -> int:
        """Store a measured pose; return its number, with which frames refer to it."""
        if self._poses == MAX_POSES:
            raise StorageError(f"{self.path}: more than {MAX_POSES} measured poses in one view")
        record = np.zeros(1, POSE_DTYPE)
        record["t_ns"], record["joints_deg"] = max(1, arm.t_ns), arm.joints_deg
        record["base_from_flange"], record["base_from_camera"] = arm.base_from_flange, base_from_camera
        self._write(self._plain_fd, record.tobytes(), self._layout.poses_offset + self._poses * record.itemsize)
        self._poses += 1
        return self._poses - 1

    def store(self, pixels: NDArray[np.uint16], *, frame_id: int, camera_ns: int, exposure_us: int) -> int:
        """Write a frame into a free slot and record it as stored but not proven; returns the slot."""
        try:
            with self._lock:
                slot = self._free.popleft()
        except IndexError:
            raise StorageError(
                f"{self.path}: no slot is free: more frames arrived than the view's bursts can produce. "
                "Check whether the trigger line bounces."
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
        """Give a frame's bytes in the file's format. They are valid within the context."""
        if not self._layout.is_packed:
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
        """Record that a slot holds a proven shot; returns the frame's checksum. It is durable after `sync()`."""
        record = self._table[slot].copy()
        record["shot"] = shot.encode()
        for name, value in fields.items():
            record[name] = value
        record["state"] = PROVEN
        self._note(slot, record)
        return int(record["xxh3"])

    def free(self, slot: int, *, give_back: bool = True) -> None:
        """Mark a slot as free: its frame may be overwritten."""
        self._note(slot, np.zeros((), FRAME_DTYPE))
        if give_back:
            with self._lock:
                self._free.append(slot)

    def _note(self, slot: int, record: NDArray[np.void] | np.void) -> None:
        """Change a slot's record in memory. The next `sync()` writes it together with others. A small write beside
        each large one would cost a tenth of the disk's speed, because they wait for each other in the file
        system."""
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
                count = os.pwrite(fd, view, offset)
                view, offset = view[count:], offset + count
        except OSError as error:
            raise disk_error(self.path, error) from error

    def sync(self) -> None:
        """Bring everything that was stored, proven and freed to the disk before this returns."""
        self._write_table()
        try:
            os.fdatasync(self._plain_fd)
        except OSError as error:
            raise disk_error(self.path, error) from error

    def refuse_lost(self, path: Path) -> None:
        """Raise StorageError if the file was removed, replaced or cut since it was opened. If its folder was
        moved, `path` is the present place."""
        try:
            is_there = os.path.samestat(os.fstat(self._plain_fd), path.stat())
        except OSError:
            is_there = False
        if not is_there or os.fstat(self._plain_fd).st_size < self._size_bytes:
            loss = "was cut" if is_there else "was removed or replaced"
            raise StorageError(
                f"{path}: {loss} while frames were written into it. Put it back as it was, then resume "
                "the run; if it is gone, its frames are lost: begin a new run."
            )

    def close(self) -> None:
        """Close the file. Records that were not synced are written, but are not durable."""
        with contextlib.suppress(StorageError):
            self._write_table()
        if self._fd != self._plain_fd:
            os.close(self._fd)
        os.close(self._plain_fd)

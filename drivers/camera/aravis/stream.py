"""The stream of one acquisition: buffers in the driver's own memory, from arming to disarming.

All buffers are queued before the camera starts, and images are taken oldest first. If an image lost packets, it is
counted, and its buffer is queued again. The gap in the frame ids shows the loss. Buffers that libaravis cleared or
aborted at start or end never held an image.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.camera.aravis.library import call, is_a, set_property

_SUCCESS, _CLEARED, _ABORTED = 0, 1, 7
"""ArvBufferStatus (arvbuffer.h)."""
_FIXED_SOCKET_BUFFER, _SOCKET_BUFFER_BYTES = 0, 2**28
"""Value of ArvGvStreamSocketBuffer (arvgvstream.h), and a size above the kernel's limit (net.core.rmem_max).
Aravis's default is the size of a frame. This is too small for a frame, because the kernel counts the memory that
packets occupy."""
_RECEIVERS = ("arv_gv_stream", "arv_uv_stream")
_PRIORITY = 10
_STRAYS_S = 0.02
"""Waiting time before any buffer is queued. It discards stray traffic: until its filter is set, a packet socket
receives all traffic of the interface, and libaravis would take it for parts of images."""
_SLICE_S = 0.05
"""Interval at which a waiting thread checks whether the stream was closed or the camera lost."""


class Pool:
    """Page-aligned memory for `slots` images of `payload_bytes` each. It is reused by the next acquisition."""

    def __init__(self, slots: int, payload_bytes: int) -> None:
        self.slots, self.payload_bytes = slots, payload_bytes
        self._pitch = -(-payload_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        memory = mmap.mmap(-1, slots * self._pitch)
        with contextlib.suppress(OSError):
            memory.madvise(mmap.MADV_HUGEPAGE)
        self._memory = np.frombuffer(memory, np.uint8)
        # The first access to a page would cost the receiving thread more time than its bytes. memset through
        # ctypes releases the GIL; numpy would block the robot's thread.
        ctypes.memset(self._memory.ctypes.data, 0, len(self._memory))
        self.out = 0
        """Number of slots with frames that are not released yet."""

    def fits(self, slots: int, payload_bytes: int) -> bool:
        """True if the pool has this many slots of this size, and none is in use."""
        return self.out == 0 and self.slots >= slots and self.payload_bytes == payload_bytes

    def slot(self, index: int) -> NDArray[np.uint8]:
        """[payload_bytes], no copy."""
        start = index * self._pitch
        return self._memory[start : start + self.payload_bytes]

    def index_of(self, address: int) -> int:
        return (address - self._memory.ctypes.data) // self._pitch


@dataclass(frozen=True)
class Taken:
    """A complete image, in its slot of the pool until `Stream.give_back`."""

    buffer: int
    slot: int
    frame_id: int
    timestamp_ns: int


@dataclass(frozen=True)
class StreamStatistics:
    """Counts of frames and packets of one acquisition, as known to the host."""

    complete_images: int = 0
    """Images that arrived complete."""
    incomplete_images: int = 0
    """Images that arrived with missing packets."""
    skipped_ids: int = 0
    """Frame ids without a complete image, including the ids of `incomplete_images`."""
    underruns: int = 0
    """Number of times that libaravis found no free buffer; several of them may concern one frame."""


class Stream:
    """Runs from construction to `close()`. Any thread may call `give_back` and `close`."""

    def __init__(
        self, library: Any, device_handle: int, device: str, pool: Pool, *, frame_retention_us: int
    ) -> None:
        self._library, self._pool = library, pool
        self._lock = threading.Lock()
        self._skipped = self._failed = self._failed_since = self._underruns_before = 0
        self._last_id = -1
        self._final: StreamStatistics | None = None
        self._handle: int | None = call(
            device, "a stream channel", library.arv_device_create_stream, device_handle, None, None
        )
        assert self._handle is not None
        self._is_gige = is_a(library, self._handle, "arv_gv_stream")
        if self._is_gige:
            set_property(library, self._handle, "frame-retention", "uint", frame_retention_us)
            set_property(library, self._handle, "socket-buffer", "enum", _FIXED_SOCKET_BUFFER)
            set_property(library, self._handle, "socket-buffer-size", "int", _SOCKET_BUFFER_BYTES)
            time.sleep(_STRAYS_S)
        _prefer_receivers()
        self._underruns_before = self._count().underruns
        for index in range(pool.slots):
            address = pool.slot(index).ctypes.data
            library.arv_stream_push_buffer(self._handle, library.arv_buffer_new(pool.payload_bytes, address))

    def next(self, timeout_s: float, first_id: int, last_id: int) -> Taken | None:
        """Return the oldest complete image; None if none came in time, or if the stream was closed.

        `first_id` and `last_id` are the ends of the transport's frame ids. It waits for 0.05 s at most.
        """
        end_s = time.monotonic() + min(timeout_s, _SLICE_S)
        while True:
            with self._lock:
                if self._handle is None:
                    return None
                handle = self._library.g_object_ref(self._handle)
            left_us = max(1, int((end_s - time.monotonic()) * 1e6))
            buffer = self._library.arv_stream_timeout_pop_buffer(handle, left_us)
            self._library.g_object_unref(handle)
            if not buffer:
                return None
            image = self._evaluate(buffer, first_id, last_id)
            if image is not None:
                return image

    def _evaluate(self, buffer: int, first_id: int, last_id: int) -> Taken | None:
        """Return the image if it is complete. Otherwise queue its buffer again, and return None."""
        library = self._library
        status = library.arv_buffer_get_status(buffer)
        with self._lock:
            if self._handle is None:
                library.g_object_unref(buffer)
                return None
            if status != _SUCCESS:
                if status not in {_CLEARED, _ABORTED}:
                    self._failed += 1
                    self._failed_since += 1
                library.arv_stream_push_buffer(self._handle, buffer)
                return None
            self._pool.out += 1
        frame_id = library.arv_buffer_get_frame_id(buffer)
        if self._last_id >= 0:
            self._skipped += (frame_id - self._last_id) % (last_id - first_id + 1) - 1
        else:
            self._skipped += self._failed_since
        self._last_id, self._failed_since = frame_id, 0
        size = ctypes.c_size_t()
        address = library.arv_buffer_get_data(buffer, ctypes.byref(size))
        return Taken(buffer, self._pool.index_of(address), frame_id, library.arv_buffer_get_timestamp(buffer))

    def give_back(self, buffer: int) -> None:
        """Queue a taken buffer again; after `close`, free it."""
        with self._lock:
            self._pool.out -= 1
            if self._handle is None:
                self._library.g_object_unref(buffer)
            else:
                self._library.arv_stream_push_buffer(self._handle, buffer)

    def statistics(self) -> StreamStatistics:
        """Counts since the stream was made. After `close` they are the counts at the end of the acquisition."""
        with self._lock:
            return self._final or self._count()

    def _count(self) -> StreamStatistics:
        completed_count, failed_count, underruns = (ctypes.c_uint64() for _ in range(3))
        self._library.arv_stream_get_statistics(self._handle, completed_count, failed_count, underruns)
        return StreamStatistics(
            completed_count.value,
            self._failed,
            self._skipped + self._failed_since,
            underruns.value - self._underruns_before,
        )

    def close(self) -> None:
        """Release stream and buffers; memory of frames in use stays valid."""
        with self._lock:
            if self._handle is None:
                return
            self._final = self._count()
            handle, self._handle = self._handle, None
        self._library.g_object_unref(handle)


def _prefer_receivers() -> None:
    """Give libaravis's receiving threads real-time priority, if this process may do this. The packet ring holds
    0.1 s, and on a busy machine a thread may wait longer than that."""
    for task in Path("/proc/self/task").glob("*"):
        with contextlib.suppress(OSError):
            if (task / "comm").read_text().strip() in _RECEIVERS:
                os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(_PRIORITY))

"""Takes frames from the armed camera and stores them, in separate threads, while the burst runs."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future

import numpy as np
from numpy.typing import NDArray

from coupole.bounded import Workers
from coupole.devices import Camera, Frame
from coupole.storage.view_writer import WRITERS

_TAKE_TIMEOUT_S, _LAST_TIMEOUT_S = 0.05, 0.005
"""Longest wait for a frame in one call of the camera: while the burst runs, and when its end is near."""
_STALL_S = 2.0
"""Duration of a stall of disk or host that the camera's buffers must cover, if memory allows."""
_FEWEST_BUFFERS = 16
_MEMORY_SHARE = 0.25
"""Share of the free memory that may be used for buffers."""


def memory_for_buffers() -> int:
    """Bytes that a camera's buffers may take, from the memory that is free now."""
    return int(_MEMORY_SHARE * os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def buffers_for(frames: int, frame_bytes: int, period_s: float, memory_bytes: int) -> int:
    """Number of camera buffers for a burst of so many frames: enough for a stall, within the memory limit."""
    return max(_FEWEST_BUFFERS, min(frames, math.ceil(_STALL_S / period_s), memory_bytes // frame_bytes))


class FrameGrabber:
    """Grabber that stores every frame of the camera, from `start()` to `stop()`, and returns its buffer.

    `keep(frame)` runs on `writers` threads and returns the slot. Frames are listed in the order of arrival.
    """

    def __init__(self, camera: Camera, keep: Callable[[Frame], int], *, writers: int = WRITERS) -> None:
        self._camera, self._keep = camera, keep
        self._pool = Workers(writers, "keep")
        self._frame_ids: list[int] = []
        self._timestamps_ns: list[int] = []
        self._slots: list[Future[int]] = []
        self._error: BaseException | None = None
        self._stopping = threading.Event()
        self._timeout_s = _TAKE_TIMEOUT_S
        self._thread = threading.Thread(target=self._take, name="grabber", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def _take(self) -> None:
        try:
            while not self._stopping.is_set():
                frame = self._camera.next_frame(self._timeout_s)
                if frame is not None:
                    self._slots.append(self._pool.submit(self._store_frame, frame))
                    self._timestamps_ns.append(frame.timestamp_ns)
                    self._frame_ids.append(frame.frame_id)
        except BaseException as error:  # noqa: BLE001  raised again in the thread that asks for frames
            self._error = error

    def _store_frame(self, frame: Frame) -> int:
        try:
            return self._keep(frame)
        finally:
            frame.release()

    def __len__(self) -> int:
        """Frames taken so far. Raises the camera's error from the thread that takes frames."""
        self.raise_error()
        return len(self._frame_ids)

    def raise_error(self) -> None:
        """Raise the camera's error from the thread that takes frames, if there was one."""
        if self._error is not None:
            raise self._error

    @property
    def count(self) -> int:
        """Frames taken so far; does not raise."""
        return len(self._frame_ids)

    def frames(self, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ids and timestamps of the first `count` frames."""
        return (
            np.array(self._frame_ids[:count], np.int64),
            np.array(self._timestamps_ns[:count], np.int64),
        )

    def is_written(self, frame: int) -> bool:
        """True if the frame's bytes are written. Raises the error of writing."""
        if not self._slots[frame].done():
            return False
        self._slots[frame].result()
        return True

    def slot(self, frame: int) -> int:
        """Return the frame's slot; waits for its bytes to be written. Raises the error of writing."""
        return self._slots[frame].result()

    def expect_end(self) -> None:
        """Wait for frames only briefly from now on, so that the thread ends soon after `end_soon`."""
        self._timeout_s = _LAST_TIMEOUT_S

    def end_soon(self) -> None:
        """Request no more frames after the frame for which the thread is waiting. Does not wait; `stop` does."""
        self._stopping.set()

    def stop(self) -> None:
        """Take no more frames; frames that were taken are still written. Never raises. Call it where a hang of
        camera or disk is noticed (`coupole.bounded`)."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._pool.end()

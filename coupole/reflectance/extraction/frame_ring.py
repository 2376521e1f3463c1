"""Frames in the order in which they are needed, read ahead into memory that is reused.

However many frames there are, memory holds only those that are worked on and a few that are being read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame

READERS = 2
"""Number of threads that read; also the number of slots in addition to the slots of the frames that are worked
on."""
_SECTOR = 512
"""Bytes. Memory for a direct read begins at a multiple of this."""


class FrameRing:
    """`with FrameRing(...)` begins to read. Errors of a frame are raised when the frame is taken."""

    def __init__(self, frames: Sequence[LightFrame], size_px: tuple[int, int], together: int) -> None:
        """Prepare the ring; at most `together` frames are worked on at a time."""
        width, height = size_px
        self._shape, slots = (height, width), min(together + READERS, len(frames))
        stride = -(-2 * width * height // 4096) * 4096 + _SECTOR  # the same pixel of all frames: not one cache set
        memory = np.empty(slots * stride + _SECTOR, np.uint8)
        begin = -memory.ctypes.data % _SECTOR
        self.pixels: NDArray[np.uint16] = memory[begin : begin + slots * stride].view(np.uint16).reshape(slots, -1)
        """[slots, memory of a frame] row by row; the numbers after a frame's pixels mean nothing."""
        self._readers = ThreadPoolExecutor(READERS)
        self._wanted = iter(frames)
        self._ahead: deque[Future[int]] = deque()

    def __enter__(self) -> Self:
        self.give_back(range(len(self.pixels)))
        return self

    def __exit__(self, *_: object) -> None:
        self._readers.shutdown(cancel_futures=True)

    def take(self) -> int:
        """Return the slot of the next frame; the slot is kept until it is given back. Raises StorageError, and
        ChecksumMismatch if the frame differs from the proven one."""
        return self._ahead.popleft().result()

    def give_back(self, slots: Iterable[int]) -> None:
        """Give back slots whose frames are no longer needed: the next frames are read into them."""
        for slot, frame in zip(slots, self._wanted, strict=False):
            self._ahead.append(self._readers.submit(self._read_frame, frame, slot))

    def _read_frame(self, frame: LightFrame, slot: int) -> int:
        pixels = self.pixels[slot, : self._shape[0] * self._shape[1]].reshape(self._shape)
        if frame.read_into is None:
            pixels[:] = frame.read()
        else:
            frame.read_into(pixels)
        return slot

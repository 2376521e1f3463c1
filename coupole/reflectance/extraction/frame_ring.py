"""Frames in the order in which they are wanted, read ahead into memory that is used again and again.

However many frames there are, memory holds those that are worked on and a few that are being read.
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
"""Threads, and slots besides those of the frames that are worked on."""
_SECTOR = 512
"""Bytes; where memory for a direct read may begin."""


class FrameRing:
    """`with FrameRing(...)` begins to read; errors of a frame are raised where it is taken."""

    def __init__(self, frames: Sequence[LightFrame], size_px: tuple[int, int], together: int) -> None:
        """Prepare the ring; at most `together` frames are worked on at a time."""
        width, height = size_px
        self._shape, slots = (height, width), min(together + READERS, len(frames))
        stride = -(-2 * width * height // 4096) * 4096 + _SECTOR  # the same pixel of all frames: not one cache set
        memory = np.empty(slots * stride + _SECTOR, np.uint8)
        begin = -memory.ctypes.data % _SECTOR
        self.pixels: NDArray[np.uint16] = memory[begin : begin + slots * stride].view(np.uint16).reshape(slots, -1)
        """[slots, memory of a frame] row by row; what is behind a frame means nothing."""
        self._readers = ThreadPoolExecutor(READERS)
        self._wanted = iter(frames)
        self._ahead: deque[Future[int]] = deque()

    def __enter__(self) -> Self:
        self.give_back(range(len(self.pixels)))
        return self

    def __exit__(self, *_: object) -> None:
        self._readers.shutdown(cancel_futures=True)

    def take(self) -> int:
        """The slot of the next frame, which is kept until it is given back. Raises StorageError, and
        ChecksumMismatch if the frame is not what was proven."""
        return self._ahead.popleft().result()

    def give_back(self, slots: Iterable[int]) -> None:
        """Slots whose frames are done with: the next frames are read into them."""
        for slot, frame in zip(slots, self._wanted, strict=False):
            self._ahead.append(self._readers.submit(self._read_frame, frame, slot))

    def _read_frame(self, frame: LightFrame, slot: int) -> int:
        pixels = self.pixels[slot, : self._shape[0] * self._shape[1]].reshape(self._shape)
        if frame.read_into is None:
            pixels[:] = frame.read()
        else:
            frame.read_into(pixels)
        return slot

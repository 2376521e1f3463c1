"""Page-aligned memory for the frames of cameras whose library delivers images one by one.

A slot is free until it is taken for a frame, and again after that frame is released. A frame of an earlier
acquisition may be released late; this has no effect on the slots of the present acquisition.
"""

from __future__ import annotations

import mmap
import threading

import numpy as np
from numpy.typing import NDArray


class FramePool:
    """`slots` pieces of memory of `slot_bytes` each. Thread-safe."""

    def __init__(self, slots: int, slot_bytes: int) -> None:
        self.slots, self.slot_bytes = slots, slot_bytes
        self._pitch = -(-slot_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        # Populated, so that a burst's first frames do not wait for page faults.
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE
        self._memory = np.frombuffer(mmap.mmap(-1, slots * self._pitch, flags), np.uint8)
        self._acquisition = 0
        self._free = list(range(slots))
        self._freed = threading.Condition()

    def begin(self) -> None:
        """Begin a new acquisition. All slots become free, even those not yet released."""
        with self._freed:
            self._acquisition += 1
            self._free = list(range(self.slots))

    def take(self, timeout_s: float) -> Slot | None:
        """Return a free slot, or None if no slot was released in time."""
        with self._freed:
            if not self._freed.wait_for(lambda: self._free, timeout_s):
                return None
            index = self._free.pop()
            start = index * self._pitch
            return Slot(self, index, self._acquisition, self._memory[start : start + self.slot_bytes])

    def give_back(self, index: int, acquisition: int) -> None:
        """Take a slot back; `Slot.release` calls this."""
        with self._freed:
            if acquisition == self._acquisition and index not in self._free:
                self._free.append(index)
                self._freed.notify()


class Slot:
    """A slot of the pool that is in use."""

    def __init__(self, pool: FramePool, index: int, acquisition: int, memory: NDArray[np.uint8]) -> None:
        self._pool, self._index, self._acquisition = pool, index, acquisition
        self.memory = memory
        """[slot_bytes], page-aligned."""

    def release(self) -> None:
        """Return the slot to the pool; a second call does nothing."""
        self._pool.give_back(self._index, self._acquisition)

"""The world's time, and how other processes read it.

World time runs `speed` times as fast as the machine's monotonic clock, never past the next event that the
world has not worked off yet (the *horizon*): a slow or lock-stepped world stretches its time instead of
letting events happen late. Four numbers in shared memory are all that a reader needs.
"""

from __future__ import annotations

import mmap
import struct
import time
from pathlib import Path

_BLOCK = struct.Struct("<QqqdqQ")
"""Sequence (odd while being written), machine ns at the anchor, world ns at the anchor, speed, horizon ns,
1 while the world lives."""
BLOCK_BYTES = _BLOCK.size
_NAP_S = 0.02
FOREVER_NS = 2**62


class ClockWriter:
    """The world's side: it owns the block and moves anchor and horizon."""

    def __init__(self, path: Path, speed: float) -> None:
        self.speed = speed
        self._sequence = 0
        self._anchor_machine_ns = time.monotonic_ns()
        self._anchor_world_ns = 0
        path.write_bytes(bytes(BLOCK_BYTES))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), BLOCK_BYTES)
        self.publish(horizon_ns=0)

    def paced_ns(self) -> int:
        """World time that the pace alone would give now, events apart."""
        return self._anchor_world_ns + int((time.monotonic_ns() - self._anchor_machine_ns) * self.speed)

    def slip_to(self, world_ns: int) -> None:
        """Let it be `world_ns` now: the world fell behind and does not rush to catch up."""
        self._anchor_machine_ns = time.monotonic_ns()
        self._anchor_world_ns = world_ns

    def publish(self, horizon_ns: int, *, alive: bool = True) -> None:
        self._sequence += 2
        fields = (self._anchor_machine_ns, self._anchor_world_ns, self.speed, horizon_ns, int(alive))
        _BLOCK.pack_into(self._memory, 0, self._sequence - 1, *fields)
        _BLOCK.pack_into(self._memory, 0, self._sequence, *fields)

    def close(self) -> None:
        self.publish(0, alive=False)
        self._memory.close()


class SharedClock:
    """A reader's side: `coupole.devices.Clock` on the block at `path`."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self._memory = mmap.mmap(file.fileno(), BLOCK_BYTES, access=mmap.ACCESS_READ)
        self._last_ns = 0

    def _read(self) -> tuple[int, int, float, int, bool]:
        while True:
            sequence, machine_ns, world_ns, speed, horizon_ns, alive = _BLOCK.unpack_from(self._memory)
            if sequence % 2 == 0 and _BLOCK.unpack_from(self._memory)[0] == sequence:
                return machine_ns, world_ns, speed, horizon_ns, bool(alive)

    @property
    def alive(self) -> bool:
        return self._read()[4]

    @property
    def speed(self) -> float:
        """The pace asked of the world, not what it reaches."""
        return self._read()[2]

    def now_ns(self) -> int:
        """World time, never running backwards."""
        machine_ns, world_ns, speed, horizon_ns, _ = self._read()
        paced_ns = world_ns + int((time.monotonic_ns() - machine_ns) * speed)
        self._last_ns = max(self._last_ns, min(paced_ns, horizon_ns))
        return self._last_ns

    def sleep(self, seconds: float) -> None:
        end_ns = self.now_ns() + int(seconds * 1e9)
        while self.alive and (left_ns := end_ns - self.now_ns()) > 0:
            time.sleep(min(_NAP_S, max(left_ns / 1e9 / self.speed, 2e-5)))

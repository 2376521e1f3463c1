"""The world's time, and its distribution to other processes.

World time runs `speed` times as fast as the machine's monotonic clock, but never past the next unprocessed event
(the *horizon*). So in a slow or lock-stepped world, time is stretched, and no event happens late. Readers need
only a few numbers in shared memory.

With `hurry_only_when_told`, the world runs fast only until a moment that its client sets; otherwise it runs in
real time. So the client's own work takes as much world time as in a real cell, and only its waiting is shortened.
"""

from __future__ import annotations

import math
import mmap
import os
import select
import struct
import time
from dataclasses import dataclass
from pathlib import Path

_BLOCK = struct.Struct("<QqqdqqQQ")
"""Fields of the block. The world writes a sequence number (odd while it writes), machine ns and world ns at the
anchor, the speed, the hurry-until ns, the horizon ns, 1 while the world runs, and its process. The client writes
its request, a hurry-until ns, after them."""
_SEQUENCE, _WISH = struct.Struct("<Q"), struct.Struct("<q")
BLOCK_BYTES = _BLOCK.size + _WISH.size
_NAP_S = 0.02
_LOOK_EVERY_NS = 20_000_000
"""Interval, by the machine's clock, at which a reader checks whether the world's process still runs."""
FOREVER_NS = 2**62


@dataclass(frozen=True)
class Pace:
    """World time as a function of machine time: `speed` from the anchor until `hurry_until_ns`, then real time
    (or slower, for a speed below 1)."""

    machine_ns: int
    world_ns: int
    speed: float
    hurry_until_ns: int

    def world_at(self, machine_ns: int) -> int:
        hurried_ns = self.world_ns + int((machine_ns - self.machine_ns) * self.speed)
        if hurried_ns <= self.hurry_until_ns:
            return hurried_ns
        switch_ns = max(self.world_ns, self.hurry_until_ns)
        machine_at_switch_ns = self.machine_ns + (switch_ns - self.world_ns) / self.speed
        return int(switch_ns + (machine_ns - machine_at_switch_ns) * min(1.0, self.speed))


class ClockWriter:
    """The world's side: it writes the block and moves anchor and horizon."""

    def __init__(self, path: Path, speed: float, *, hurry_only_when_told: bool = False) -> None:
        self.speed = speed
        self._sequence = 0
        self._told = hurry_only_when_told
        path.write_bytes(bytes(BLOCK_BYTES))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), BLOCK_BYTES)
        until_ns = 0 if hurry_only_when_told else FOREVER_NS
        self._pace = Pace(time.monotonic_ns(), 0, speed, until_ns)
        self.publish(horizon_ns=0)

    def paced_ns(self) -> int:
        """World time by the pace alone; events are ignored."""
        now_ns = time.monotonic_ns()
        world_ns = self._pace.world_at(now_ns)
        if self._told:
            (wish_ns,) = _WISH.unpack_from(self._memory, _BLOCK.size)
            if wish_ns != self._pace.hurry_until_ns:
                self._pace = Pace(now_ns, world_ns, self.speed, wish_ns)
        return world_ns

    def machine_s_until(self, world_ns: int) -> float:
        """Shortest machine time until `world_ns`; the pace may be slower."""
        return (world_ns - self.paced_ns()) / 1e9 / self.speed

    def slip_to(self, world_ns: int) -> None:
        """Set world time to `world_ns`. A world that is behind its pace does not catch up."""
        self._pace = Pace(time.monotonic_ns(), world_ns, self.speed, self._pace.hurry_until_ns)

    def publish(self, horizon_ns: int, *, alive: bool = True) -> None:
        self._sequence += 2
        pace = self._pace
        anchor = (pace.machine_ns, pace.world_ns, pace.speed, pace.hurry_until_ns)
        # Whole slices, in this order: `pack_into` would zero the block first, which a reader could see.
        block = _BLOCK.pack(self._sequence, *anchor, horizon_ns, int(alive), os.getpid())
        self._memory[:8] = _SEQUENCE.pack(self._sequence - 1)
        self._memory[8 : _BLOCK.size] = block[8:]
        self._memory[:8] = block[:8]

    def close(self) -> None:
        self.publish(0, alive=False)
        self._memory.close()


class SharedClock:
    """A reader's side: `coupole.clock.Clock` on the block at `path`.

    When the world has ended, or its process was killed, time goes on at the world's speed. So no wait by this
    clock lasts for ever.
    """

    _process: int | None = None
    """A descriptor that can be read once the world's process has ended; None if the system has no such
    descriptors."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), BLOCK_BYTES)
        self._last_ns = 0
        self._looked_ns = time.monotonic_ns()
        self._gone_since_ns: int | None = None
        try:
            self._process = os.pidfd_open(self._read_block()[3])
        except ProcessLookupError:
            self._gone_since_ns = self._looked_ns
        except (AttributeError, OSError):  # an old kernel, or not Linux: the end of a killed world is not noticed
            pass

    def __del__(self) -> None:
        if self._process is not None:
            os.close(self._process)

    def _read_block(self) -> tuple[Pace, int, bool, int]:
        while True:
            sequence, *pace, horizon_ns, alive, pid = _BLOCK.unpack_from(self._memory)
            is_consistent = sequence % 2 == 0 and _SEQUENCE.unpack_from(self._memory)[0] == sequence
            if is_consistent or self._gone_since_ns is not None:
                return Pace(*pace), horizon_ns, bool(alive), pid
            self._look()

    @property
    def alive(self) -> bool:
        """True while the world runs."""
        self._look()
        return self._gone_since_ns is None

    def _look(self) -> None:
        """Every now and then, look whether the world has ended."""
        now_ns = time.monotonic_ns()
        if self._gone_since_ns is not None or now_ns - self._looked_ns < _LOOK_EVERY_NS:
            return
        self._looked_ns = now_ns
        says_so = not _BLOCK.unpack_from(self._memory)[6]
        if says_so or (self._process is not None and select.select([self._process], [], [], 0)[0]):
            self._gone_since_ns = now_ns

    def now_ns(self) -> int:
        """World time; it never runs backwards."""
        self._look()
        if self._gone_since_ns is not None:
            return self._last_ns + int((time.monotonic_ns() - self._gone_since_ns) * self._read_block()[0].speed)
        pace, horizon_ns, _, _ = self._read_block()
        self._last_ns = max(self._last_ns, min(pace.world_at(time.monotonic_ns()), horizon_ns))
        return self._last_ns

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        end_ns = self.now_ns() + int(seconds * 1e9)
        end_s = time.monotonic() + at_most_s
        speed = self._read_block()[0].speed
        while (left_ns := end_ns - self.now_ns()) > 0 and (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(min(_NAP_S, left_s, max(left_ns / 1e9 / speed, 2e-5)))

    def hurry(self, until_ns: int) -> None:
        """Let a world with `hurry_only_when_told` run at its speed until then."""
        self._memory[_BLOCK.size :] = _WISH.pack(until_ns)

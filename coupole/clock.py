"""The rig's clock, and deadlines on it."""

from __future__ import annotations

import math
import time
from typing import Protocol


class Clock(Protocol):
    """The rig's clock. On a simulated rig it is the world's clock, which may run faster or wait."""

    def now_ns(self) -> int: ...

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        """Wait `seconds` on this clock, but no longer than `at_most_s` on the machine's clock. Returns early only
        if the clock's source is gone."""

    def hurry(self, until_ns: int) -> None:
        """Say that the caller only waits until then. A simulated clock may run fast meanwhile; a real clock
        ignores this."""


class SystemClock:
    """The clock of a rig of real devices, which is the machine's monotonic clock."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        time.sleep(min(seconds, at_most_s))

    def hurry(self, until_ns: int) -> None:
        """Do nothing: this is a real clock."""


class Deadline:
    """Expires `seconds` from now on the rig's clock, or when that clock seems to have stopped.

    The guard on the machine's own clock (`10 * seconds + 20 s`) matters only if the rig's clock can stop: a
    simulated world that ended or hangs.
    """

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock = clock
        self._end_ns = clock.now_ns() + int(seconds * 1e9)
        self._guard = time.monotonic() + 10.0 * seconds + 20.0
        self.seconds = seconds

    @property
    def remaining_s(self) -> float:
        """Seconds left on the rig's clock, 0 when expired."""
        if time.monotonic() > self._guard:
            return 0.0
        return max(0.0, (self._end_ns - self._clock.now_ns()) / 1e9)

    @property
    def has_expired(self) -> bool:
        return self.remaining_s <= 0.0

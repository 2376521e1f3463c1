"""A clock for those who watch calls that may hang: no time passes while the machine does something else."""

from __future__ import annotations

import time

import cells

from coupole import bounded


class WatchersClock:
    """For `bounded.time`: it goes on when it is told to."""

    def __init__(self) -> None:
        self.now_s = time.monotonic()

    def monotonic(self) -> float:
        return self.now_s

    def advance(self, seconds: float) -> None:
        """Go on, and wait until the watcher has looked."""
        self.now_s += seconds
        cells.wait_until(lambda: bounded._looked_s[-1] >= self.now_s, "a look at the calls under way")

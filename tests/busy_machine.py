"""How busy this machine is just now, for tests whose real wires must keep up with a world's clock."""

from __future__ import annotations

import time

_WORK_S = 0.05
"""CPU time of the piece of work: several times as long as a process may run before another one has its turn."""
_MOST = 4.0
"""A world that is slowed down more than this would make a test take minutes."""


def slowness() -> float:
    """Return how many times as long as on an idle machine a piece of work takes just now, from 1 to `_MOST`."""
    began_s, until_s = time.monotonic(), time.thread_time() + _WORK_S
    while time.thread_time() < until_s:
        pass
    return min(max(1.0, (time.monotonic() - began_s) / _WORK_S), _MOST)

"""Check whether what was asked of a console is still wanted when the console gets to it.

A console stands still if it is stopped (Ctrl-Z, SIGSTOP), or if its machine sleeps. When it runs again it finds
requests whose senders have long given up. So nothing begins for a caller whose connection is gone. Where that
cannot be seen (a page that is still open), nothing begins of what may have come while the console stood still.
Requests that end or pause something are always obeyed.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable

STOOD_STILL_S = 5.0
"""A console that stood still for this time begins nothing that it was asked meanwhile."""
HELD_STOOD_STILL_S = 1.0
"""The same time for a motion by hand, whose button is held."""
_NOTED_S, _BACKLOG_S = 0.5, 2.0
_ENDINGS = ("/stop", "/pause", "/sign-out", "/control/give")


def begins_nothing(method: str, path: str) -> bool:
    """Tell whether a request of the HTTP interface only reads, ends or pauses: it counts, whoever is gone."""
    return method in ("GET", "HEAD", "DELETE") or path.endswith(_ENDINGS)


def hung_up(connection: socket.socket) -> bool:
    """Tell whether the other end of a connection is closed, whatever it has sent before."""
    if connection.fileno() < 0:
        return True
    poll = select.poll()
    poll.register(connection.fileno(), select.POLLRDHUP)
    return bool(poll.poll(0))


def _now_s() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)  # goes on while the machine sleeps


class LoopWatch:
    """Knows for how long the console's loop did not run: the loop beats, anybody asks, from any thread."""

    def __init__(self, now_s: Callable[[], float] = _now_s) -> None:
        self._now_s, self._beat_s = now_s, now_s()
        self._stood_s = self._awake_s = 0.0

    def beat(self) -> None:
        """The loop runs."""
        now_s = self._now_s()
        stood_s = now_s - self._beat_s
        if stood_s > _NOTED_S and (stood_s > self._stood_s or now_s - self._awake_s > _BACKLOG_S):
            self._stood_s, self._awake_s = stood_s, now_s
        self._beat_s = now_s

    def refusal(self, longest_s: float = STOOD_STILL_S) -> str:
        """Return why nothing may begin now: what came while the console stood still reaches it now; else empty."""
        now_s = self._now_s()
        stood_s = now_s - self._beat_s
        if now_s - self._awake_s < _BACKLOG_S:
            stood_s = max(stood_s, self._stood_s)
        if stood_s < longest_s:
            return ""
        return (
            f"the console was frozen for {stood_s:.1f} s (it was stopped, or its machine slept), and begins "
            "nothing that was requested in this time: look at the cell, and ask again"
        )

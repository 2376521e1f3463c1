"""Check whether a request to the console is still wanted when the console reads it.

A console is frozen while it is stopped (Ctrl-Z, SIGSTOP), and while its machine sleeps. When it runs again, it
finds requests whose senders may have given up long ago. So nothing begins for a caller who has disconnected. If
that cannot be seen (a page is still open), nothing begins that may have been requested while the console was
frozen. Requests that end or pause something are always obeyed.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable

STOOD_STILL_S = 5.0
"""A console that was frozen for this time, s, begins nothing that was requested in this time."""
HELD_STOOD_STILL_S = 1.0
"""The same time, s, for a motion by hand, which lasts while its button is held."""
_NOTED_S, _BACKLOG_S = 0.5, 2.0
_ENDINGS = ("/stop", "/pause", "/sign-out", "/control/give")


def begins_nothing(method: str, path: str) -> bool:
    """Tell whether a request of the HTTP interface only reads, ends or pauses something. These are obeyed even if
    the sender is gone."""
    return method in ("GET", "HEAD", "DELETE") or path.endswith(_ENDINGS)


def hung_up(connection: socket.socket) -> bool:
    """Tell whether the other end of a connection is closed, also if it sent data before."""
    if connection.fileno() < 0:
        return True
    poll = select.poll()
    poll.register(connection.fileno(), select.POLLRDHUP)
    return bool(poll.poll(0))


def _now_s() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)  # this clock goes on while the machine sleeps


class LoopWatch:
    """Measures for how long the console's event loop did not run. The loop calls `beat`; `refusal` may be called
    by any thread."""

    def __init__(self, now_s: Callable[[], float] = _now_s) -> None:
        self._now_s, self._beat_s = now_s, now_s()
        self._stood_s = self._awake_s = 0.0

    def beat(self) -> None:
        """Note that the loop runs."""
        now_s = self._now_s()
        stood_s = now_s - self._beat_s
        if stood_s > _NOTED_S and (stood_s > self._stood_s or now_s - self._awake_s > _BACKLOG_S):
            self._stood_s, self._awake_s = stood_s, now_s
        self._beat_s = now_s

    def refusal(self, longest_s: float = STOOD_STILL_S) -> str:
        """Return why nothing may begin now: the request may have been sent while the console was frozen. Otherwise
        empty."""
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

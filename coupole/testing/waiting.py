"""Calls in separate threads, and waiting for expected events, for the conformance classes."""

from __future__ import annotations

import gc
import linecache
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

_PATIENCE_S = 20.0
_REACHES_ITS_PLACE_S = 5.0
"""Time of the machine, s, after which a call is assumed to wait for its turn, although nothing shows it."""


class Call:
    """A call of the driver in a separate thread."""

    def __init__(self, action: Callable[[], Any]) -> None:
        self.error: BaseException | None = None
        self._action = action
        self._reached_s = time.monotonic() + _REACHES_ITS_PLACE_S
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def wait(self) -> BaseException | None:
        """Wait for the end of the call; return its error, or None."""
        self._thread.join(20.0)
        assert not self._thread.is_alive()
        return self.error

    def waits_its_turn(self) -> bool:
        """True if the thread of the call is about to take a lock. The line of code at which the thread is shows
        this. If a driver keeps the order by other means, the result is True after a fixed time."""
        if time.monotonic() > self._reached_s:
            return True
        gc.disable()  # a garbage collection in there may wait for ever (CPython issue gh-106883)
        try:
            frame = sys._current_frames().get(self._thread.ident or 0)
        finally:
            gc.enable()
        if frame is None:
            return False
        file = frame.f_code.co_filename
        return file.endswith("fair_lock.py") or "with self._lock" in linecache.getline(file, frame.f_lineno)

    def _run(self) -> None:
        try:
            self._action()
        except BaseException as error:  # noqa: BLE001  the test looks at it
            self.error = error


def wait_until(condition: Callable[[], bool], event_name: str) -> None:
    """Wait for a condition; fail if it does not become true. Only a broken box or driver lets the time run out."""
    end_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end_s, f"waited in vain for {event_name}"
        time.sleep(0.005)

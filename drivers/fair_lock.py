"""One call to a device at a time, whatever thread it comes from, in the order of asking."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator


class Turns:
    """A lock that is fair: who waits goes before the thread that held it last and wants it again.

    So a thread that polls a device without a pause cannot shut the others out, as it could with a plain lock.
    """

    def __init__(self) -> None:
        self._queue, self._busy = threading.Lock(), threading.Lock()

    @contextlib.contextmanager
    def mine(self) -> Iterator[None]:
        """The device is the caller's. Not to be entered twice by one thread."""
        with self._queue:
            self._busy.acquire()
        try:
            yield
        finally:
            self._busy.release()

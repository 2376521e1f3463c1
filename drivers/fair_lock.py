"""A lock that serves threads in the order in which they asked."""

from __future__ import annotations

import threading
from types import TracebackType


class FairLock:
    """A thread that waits goes before the thread that held the lock last and wants it again.

    With a plain lock a thread that polls a device without a pause could shut the others out. Not re-entrant.
    """

    def __init__(self) -> None:
        self._queue, self._held = threading.Lock(), threading.Lock()

    def __enter__(self) -> None:
        with self._queue:
            self._held.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.release()

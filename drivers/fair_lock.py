"""A lock that is granted to threads in the order in which they request it."""

from __future__ import annotations

import threading
from types import TracebackType


class FairLock:
    """A waiting thread gets the lock before the thread that has just released it can take it again.

    With a plain lock, a thread that polls a device without pause could starve the others. The lock is not
    re-entrant.
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

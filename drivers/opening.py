"""Closes a device whose opening fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def closed_on_failure(close: Callable[[], None]) -> Iterator[None]:
    """Call `close` if the block raises."""
    try:
        yield
    except BaseException:
        close()
        raise

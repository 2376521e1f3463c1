"""Work that is divided into parts for threads, with kernels that are compiled."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import CodeType
from typing import Any, TypeVar

Done = TypeVar("Done")

_begun: dict[CodeType, threading.Lock] = {}
_ready: set[CodeType] = set()
"""Functions that were called once in this process, so that their kernels are loaded."""


def first_alone(work: Callable[..., Done]) -> Callable[..., Done]:
    """Return a function for threads. The first call in this process ends before any other begins, because it loads
    or compiles the kernels that it calls. If several threads do so together, they sometimes fail (numba 0.68:
    "dictionary changed size during iteration")."""
    kind: CodeType = work.__code__

    def call(*arguments: Any) -> Done:
        if kind not in _ready:
            with _begun.setdefault(kind, threading.Lock()):
                if kind not in _ready:
                    done = work(*arguments)
                    _ready.add(kind)
                    return done
        return work(*arguments)

    return call


def in_threads(work: Callable[[int], object], count: int, *, part: int = 1, threads: int | None = None) -> None:
    """Call `work(first)` for the first number of each `part` of `count`, in the given number of threads; by
    default, one thread for each core. The first call of a kind in this process runs alone."""
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        list(pool.map(first_alone(work), range(0, count, part)))

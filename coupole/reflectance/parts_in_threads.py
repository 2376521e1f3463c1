"""Work in parts, in threads, with kernels that are compiled."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import CodeType

_ready: set[CodeType] = set()
"""Work that was done once in this process: its kernels are loaded."""


def in_threads(work: Callable[[int], object], count: int, *, part: int = 1, threads: int | None = None) -> None:
    """Do `work(first)` for the first of each `part` of `count`, by so many threads, or as many as there are cores.

    The first part of a kind of work is done before the others begin: it loads or compiles what it calls, which
    failed once in several threads at a time (numba 0.68: "dictionary changed size during iteration").
    """
    firsts = range(0, count, part)
    kind = work.__code__
    if kind not in _ready and firsts:
        work(firsts[0])
        _ready.add(kind)
        firsts = firsts[1:]
    if not firsts:
        return
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        list(pool.map(work, firsts))

"""Numba's kernels, each compiled by one process while the others wait for what it leaves in the cache.

Six workers and their worlds begin at once with the same kernels. Without this each of them compiles what all of
them are about to find in the cache.
"""

from __future__ import annotations

import fcntl
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core import entrypoints
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

_compiling: set[Path] = set()
"""Locks that this process has; whoever has the compiler's lock may ask."""


def compile_each_kernel_once() -> None:
    """In this process, and in those that it forks. No kernel of ours wants other packages' extensions of numba
    (awkward's, sparse's): they are not imported, which saves 0.2 s in each process."""
    entrypoints._already_initialized = True
    compiles = Dispatcher.compile

    @functools.wraps(compiles)
    def compile_alone(kernel: Any, *signature: Any) -> Any:
        with _alone(kernel):
            return compiles(kernel, *signature)  # which looks into the cache first

    Dispatcher.compile = compile_alone


@contextmanager
def _alone(kernel: Any) -> Iterator[None]:
    """Only this process compiles the kernel; it may compile those that this one calls, meanwhile. The compiler's
    own lock comes first: processes then wait for each other in the order of calls, which has no circles."""
    if kernel.stats.cache_path is None:
        yield
        return
    path = Path(kernel.stats.cache_path) / f"{kernel.py_func.__qualname__}.lock"
    with global_compiler_lock:
        if path in _compiling:  # one that calls itself
            yield
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            _compiling.add(path)
            try:
                yield
            finally:
                _compiling.remove(path)

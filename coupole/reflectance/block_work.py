"""Blocks of work, done in this process or by the workers of a cluster (dask.distributed).

A block is a function with few arguments; its result is small or is a file. Workers share the file system of the
result with the process that asks them. If a worker dies, another one repeats its task.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from coupole.errors import InputError

Block = TypeVar("Block")
Done = TypeVar("Done")
Said = Callable[[str, int, int], None]
_ANSWERS_S = 10.0
_AHEAD = 3
"""Blocks for each thread of the workers that are requested before their results are taken."""
_BLOCKS_EACH, _FEWEST_ROWS, _MOST_ROWS = 8, 256, 1 << 12
"""Least number of blocks for each thread; least and largest number of triangles in a block."""
_ROWS_OF_A_CORE = 1024
"""Number of triangles of a block in this process, for each core: four parts for each thread, and arrays so small
that the C library uses their memory again. For larger arrays the operating system clears new pages each time."""
_MISSING = "--scheduler: dask.distributed is not installed here; `pip install 'coupole[cluster]'` adds it"


def silent(step: str, done_count: int, of: int) -> None:
    """Report nothing."""


class Workshop(Protocol):
    """A place where blocks are processed."""

    threads: int | None
    """Number of threads that a block may use; None for one thread for each core."""

    def most_rows(self, count: int) -> int:
        """Return the number of triangles of a block, for `count` triangles in all."""
        ...

    def map(self, function: Callable[[Block], Done], blocks: Iterable[Block]) -> Iterator[Done]:
        """Return the results in the order of the blocks."""
        ...

    def everywhere(self, function: Callable[[], Any]) -> None:
        """Call a function in each process that processes blocks."""
        ...

    def reporter(self, say: Said) -> Said:
        """Return the function that a block calls to report its progress."""
        ...

    def refuse_blind(self, folder: Path, witness: str) -> None:
        """Raise InputError if a worker does not see the same content of one file of a folder as this machine, or
        has another version of Coupole.
        """
        ...


class Here:
    """Workshop in this process: one block after the other."""

    threads: int | None = None

    def most_rows(self, count: int) -> int:
        return _ROWS_OF_A_CORE * len(os.sched_getaffinity(0))

    def map(self, function: Callable[[Block], Done], blocks: Iterable[Block]) -> Iterator[Done]:
        return map(function, blocks)

    def everywhere(self, function: Callable[[], Any]) -> None:
        function()

    def reporter(self, say: Said) -> Said:
        return say

    def refuse_blind(self, folder: Path, witness: str) -> None:
        pass


class Cluster:
    """Workshop in the workers of a scheduler: each of their threads processes one block at a time."""

    threads: int | None = 1

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address

    def most_rows(self, count: int) -> int:
        """Return the number of triangles of a block, small enough that no worker waits long for the last block of
        another."""
        return int(np.clip(-(-count // (_BLOCKS_EACH * self._all_threads)), _FEWEST_ROWS, _MOST_ROWS))

    def map(self, function: Callable[[Block], Done], blocks: Iterable[Block]) -> Iterator[Done]:
        futures: deque[Any] = deque()
        ahead = _AHEAD * self._all_threads
        for block in blocks:
            futures.append(self._client.submit(_done_alone, function, block, pure=False))
            if len(futures) == ahead:
                yield self._result(futures.popleft())
        while futures:
            yield self._result(futures.popleft())

    @property
    def _all_threads(self) -> int:
        return max(1, sum(map(int, self._client.nthreads().values())))

    def _result(self, future: Any) -> Any:
        from dask.distributed import CancelledError, KilledWorker
        from distributed.comm.core import CommClosedError

        try:
            return future.result()
        except KilledWorker as error:
            raise InputError(
                f"--scheduler: {error.allowed_failures + 1} workers died of the same block: give them more memory "
                "or fewer threads (`--nthreads 1`)"
            ) from error
        except (CancelledError, CommClosedError) as error:
            raise InputError(
                f"--scheduler: the scheduler {self._address} is gone; start it, and give this command again: "
                "finished work is kept"
            ) from error

    def everywhere(self, function: Callable[[], Any]) -> None:
        self._client.run(function)

    def reporter(self, say: Said) -> Said:
        return silent

    def refuse_blind(self, folder: Path, witness: str) -> None:
        here = _seen_from_here(folder / witness)
        for worker, there in self._client.run(_seen_from_here, folder / witness).items():
            if there[1] != here[1]:
                raise InputError(
                    f"--scheduler: the worker {worker} has Coupole {there[1]}, this machine has {here[1]}"
                )
            if there != here:
                raise InputError(
                    f"--scheduler: the worker {worker} does not see {folder} as it is here: put runs, records and "
                    "result on a file system that all machines have under the same path"
                )


def _seen_from_here(witness: Path) -> tuple[str | None, str]:
    try:
        return witness.read_text(encoding="utf-8"), version("coupole")
    except OSError:
        return None, version("coupole")


def _done_alone(function: Callable[[Block], Done], block: Block) -> Done:
    """Process a block in a worker. BLAS must not use threads in which other blocks are processed."""
    threadpool_limits(1, user_api="blas")
    return function(block)


@contextmanager
def workshop(scheduler: str | None) -> Iterator[Workshop]:
    """Yield a workshop: this process, or the workers of the scheduler at an address. Raises InputError if the
    scheduler does not answer or has no workers."""
    if scheduler is None:
        yield Here()
        return
    try:
        from dask.distributed import Client
        from distributed.comm.addressing import get_address_host_port
    except ImportError as error:
        raise InputError(_MISSING) from error
    try:
        get_address_host_port(scheduler)  # of another, the client waits for itself when the program ends
        client: Any = Client(scheduler, timeout=_ANSWERS_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler: no scheduler answers at {scheduler}; `dask scheduler` starts one and prints its address"
        ) from error
    with client:
        if not client.nthreads():
            raise InputError(
                f"--scheduler: {scheduler} has no workers; `dask worker {scheduler} --nthreads 1` starts one"
            )
        yield Cluster(client, scheduler)

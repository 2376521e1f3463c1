"""Matching of pairs of scans in several processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

from coupole.scan.registration.pair_matching import PairMotion, improve, match
from coupole.scan.registration.prepared_scan import PreparedScan
from coupole.scan.registration.viewpoint import Floats

Task = tuple[int, int, Floats | None]
"""Numbers of two scans, and `first_from_second` if it is approximately known."""
Say = Callable[[str, int, int], None]
_WORTH_PROCESSES = 30
"""Number of tasks above which several processes save more time than their start takes."""
_TOGETHER = 8

_scans_there: list[PreparedScan] = []
"""Scans of a matching process."""


class Search:
    """Matches pairs of the given scans."""

    def __init__(self, scans: Sequence[PreparedScan], processes: int) -> None:
        self._scans, self._processes = scans, processes
        self._pool: ProcessPoolExecutor | None = None

    def run(self, task_name: str, tasks: Sequence[Task], say: Say) -> list[PairMotion]:
        """Return the accepted motions, in the order of the tasks."""
        motions = []
        for number, motion in enumerate(self._motions(tasks)):
            say(task_name, number + 1, len(tasks))
            if motion is not None:
                motions.append(motion)
        return motions

    def _motions(self, tasks: Sequence[Task]) -> Iterable[PairMotion | None]:
        if self._processes < 2 or (self._pool is None and len(tasks) < _WORTH_PROCESSES):
            return (_match_task(self._scans, task) for task in tasks)
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._processes, context, _begin, (self._scans,))
        return self._pool.map(_matched_there, tasks, chunksize=min(_TOGETHER, max(1, len(tasks) // 16)))

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


@contextmanager
def search_of(scans: Sequence[PreparedScan], processes: int | None = None) -> Iterator[Search]:
    """Return a search with the given number of processes; by default, one for each processor."""
    search = Search(scans, processes or len(os.sched_getaffinity(0)))
    try:
        yield search
    finally:
        search.close()


def _begin(scans: Sequence[PreparedScan]) -> None:
    _scans_there[:] = scans


def _matched_there(task: Task) -> PairMotion | None:
    return _match_task(_scans_there, task)


def _match_task(scans: Sequence[PreparedScan], task: Task) -> PairMotion | None:
    first, second, guess = task
    if guess is None:
        return match(first, second, scans[first], scans[second])
    return improve(first, second, scans[first], scans[second], guess, "prediction")

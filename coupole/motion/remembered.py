"""Keeps the last few results of computations on arrays, by the content of these arrays.

A process may check a cell several times. A console checks plans, a session checks again before it begins, and the
report needs the occlusion again. The same arm and object give the same bodies and patches.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

import numpy as np
import xxhash
from numpy.typing import NDArray

Result = TypeVar("Result")

_LARGEST_BYTES = 64 * 2**20
"""Results of larger arrays are computed each time, because they would fill the memory."""


class Remembered(Generic[Result]):
    """A store of at most `most` results. The result that was not used for the longest time is removed first.
    Threads may share the store. Nobody may change a result."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._results: OrderedDict[Hashable, Result] = OrderedDict()
        self._lock = threading.Lock()

    def result(
        self, arguments: tuple[Hashable | NDArray[np.float64], ...], compute: Callable[[], Result]
    ) -> Result:
        """Return the result for these arguments. Arrays are compared by their content, all other arguments by
        themselves."""
        if sum(argument.nbytes for argument in arguments if isinstance(argument, np.ndarray)) > _LARGEST_BYTES:
            return compute()
        key = tuple(map(_key, arguments))
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
                return self._results[key]
        result = compute()
        with self._lock:
            self._results[key] = result
            while len(self._results) > self._most:
                self._results.popitem(last=False)
        return result


def _key(argument: Hashable | NDArray[np.float64]) -> Hashable:
    if isinstance(argument, np.ndarray):
        content = np.ascontiguousarray(argument)
        return content.shape, content.dtype.str, xxhash.xxh3_128_digest(content.tobytes())
    return argument

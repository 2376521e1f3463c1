"""Results that are remembered belong to exactly these arguments."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.motion import remembered
from coupole.motion.remembered import Remembered


@pytest.fixture
def computed() -> list[float]:
    return []


def total(results: Remembered[float], computed: list[float], values: np.ndarray, name: str = "") -> float:
    def compute() -> float:
        computed.append(float(values.sum()))
        return computed[-1]

    return results.result((values, name), compute)


def test_equal_arrays_give_the_remembered_result_and_others_their_own(computed: list[float]) -> None:
    results: Remembered[float] = Remembered(most=8)
    values = np.arange(6.0)
    assert total(results, computed, values) == total(results, computed, values.copy()) == 15.0
    assert computed == [15.0]
    values[5] = 6.0  # the same array, changed in place
    assert total(results, computed, values) == 16.0
    total(results, computed, values, name="another")
    total(results, computed, values.reshape(2, 3))
    total(results, computed, values.reshape(2, 3).T)
    total(results, computed, values.astype(np.float32))
    assert len(computed) == 6


def test_the_result_that_was_asked_for_longest_ago_makes_room(computed: list[float]) -> None:
    results: Remembered[float] = Remembered(most=2)
    for value in (1.0, 2.0, 1.0, 3.0, 1.0, 2.0):
        total(results, computed, np.array([value]))
    assert computed == [1.0, 2.0, 3.0, 2.0]


def test_results_of_large_arrays_are_not_kept(computed: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remembered, "_LARGEST_BYTES", 40)
    results: Remembered[float] = Remembered(most=2)
    for values in (np.ones(5), np.ones(5), np.ones(6), np.ones(6)):
        total(results, computed, values)
    assert computed == [5.0, 6.0, 6.0]

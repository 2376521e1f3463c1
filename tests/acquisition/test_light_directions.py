"""Normals without one light are those of least squares over the others, and the judging of LEDs can be stopped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.acquisition.commissioning import light_directions
from coupole.acquisition.commissioning.light_directions import Normals, deviations_deg
from coupole.errors import Interrupted

RIDGE = 1e-3
"""Square root of the ridge: one more equation `RIDGE * b = 0` for each coordinate."""


def seen(seed: int, leds: int, pixels: int, flat: float) -> tuple[NDArray[np.float64], ...]:
    """Pictures, lights about the z axis in a cone of `flat` degrees, lit, good; of a random body."""
    random = np.random.default_rng(seed)
    lights = random.normal(size=(leds, 3)) * [np.radians(flat), np.radians(flat), 0.1] + [0.0, 0.0, 1.0]
    pictures = random.uniform(0.0, 1000.0, (leds, pixels))
    return pictures, lights, random.random((leds, pixels)) < 0.8, random.random(leds) < 0.9


def by_least_squares(
    pictures: NDArray[np.float64], lights: NDArray[np.float64], used: NDArray[np.bool_], led: int
) -> NDArray[np.float64]:
    """[3, pixels] each pixel solved alone, by the rows of the lights that reach it, without one LED."""
    found = np.zeros((3, pictures.shape[1]))
    for pixel in range(pictures.shape[1]):
        rows = [k for k in np.flatnonzero(used[:, pixel]) if k != led]
        if len(rows) >= 4:
            equations = np.vstack([lights[rows], RIDGE * np.eye(3)])
            found[:, pixel] = np.linalg.lstsq(equations, [*pictures[rows, pixel], 0.0, 0.0, 0.0], rcond=None)[0]
    return found


@given(st.integers(0, 2**32 - 1), st.integers(2, 24), st.sampled_from([60.0, 10.0, 1.0]))
def test_taking_a_light_out_gives_what_least_squares_gives_without_it(seed: int, leds: int, flat: float) -> None:
    pictures, lights, lit, good = seen(seed, leds, 12, flat)
    used = lit.astype(bool) & good.astype(bool)[:, None]
    normals = Normals(pictures, lights, lit.astype(bool), good.astype(bool))
    for led in range(leds):
        expected = by_least_squares(pictures, lights, used, led)
        scale = np.abs(expected).max(initial=1.0)
        # Normal equations square the condition: of lights within a degree they keep half of the digits.
        assert normals.without(led) == pytest.approx(expected, abs=scale * (1e-9 if flat > 5.0 else 1e-5))


def test_a_light_that_alone_tells_one_direction_is_taken_out_by_solving_anew() -> None:
    lights = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 2.0, 1e-9], [0.0, 0.0, 300.0]])
    pictures = np.array([[10.0], [20.0], [30.0], [50.0], [7e4]])
    every = np.ones((5, 1), bool)
    found = Normals(pictures, lights, every, np.ones(5, bool)).without(4)
    assert found == pytest.approx(by_least_squares(pictures, lights, every, 4), abs=1e-4)


def test_judging_is_ended_between_two_leds() -> None:
    judged: list[int] = []

    def each(_: str, numbers: Iterable[int]) -> Iterator[int]:
        for number in numbers:
            if len(judged) == 3:
                raise Interrupted("Ctrl-C")
            judged.append(number)
            yield number

    pictures, lights, _, _ = seen(1, 20, 50, 60.0)
    with pytest.raises(Interrupted):
        deviations_deg(pictures, lights, each)
    assert judged == [0, 1, 2]


def test_a_whole_dome_is_judged_with_one_solution_for_each_round(monkeypatch: pytest.MonkeyPatch) -> None:
    solved = []

    class Counted(Normals):
        def __init__(self, *seen: NDArray[np.float64]) -> None:
            solved.append(1)
            super().__init__(*seen)  # type: ignore[arg-type]

    monkeypatch.setattr(light_directions, "Normals", Counted)
    random = np.random.default_rng(1)
    lights = random.normal((0.0, 0.0, 2.0), 1.0, (1080, 3))
    normals = random.normal(size=(3, 200))
    deviations_deg(np.clip(lights @ normals, 0.0, None) * 1000.0, lights)
    assert len(solved) <= 5

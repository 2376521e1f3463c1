"""Light of the dome's LEDs at a point, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.plan.led_table import LedTable

ONE = LedTable(
    ids=np.array([7]),
    boards=np.array([0]),
    positions_mm=np.array([[0.0, 0.0, 2000.0]]),
    normals=np.array([[0.0, 0.0, -1.0]]),
    flux_lm=np.array([100.0]),
)


def test_below_an_led_the_light_is_flux_over_pi_and_the_square_of_the_distance_in_metres() -> None:
    assert ONE.illuminance_lux([[0.0, 0.0, 0.0]])[0, 0] == pytest.approx(100.0 / np.pi / 4.0)


@pytest.mark.parametrize(("emission", "power"), [("lambertian", 1), ("paper", 2)])
def test_beside_its_axis_it_falls_with_the_cosine(emission: str, power: int) -> None:
    at = [[2000.0, 0.0, 0.0]]
    assert ONE.illuminance_lux(at, emission=emission)[0, 0] == pytest.approx(
        100.0 / np.pi / 8.0 * 0.5 ** (power / 2)
    )


@pytest.mark.parametrize("emission", ["lambertian", "paper"])
def test_behind_an_led_there_is_none(emission: str) -> None:
    assert ONE.illuminance_lux([[0.0, 0.0, 2500.0], [300.0, 0.0, 2001.0]], emission=emission).tolist() == [
        [0.0],
        [0.0],
    ]

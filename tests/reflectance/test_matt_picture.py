"""Pictures that views are compared by, where an exposure clips bright parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.reflectance.alignment.matt_picture import matt_picture

BLACK, WHITE = 60, 4095
SHAPE = (40, 60)
LEDS = (3, 5, 8, 9, 12)
RADIANCE = np.repeat(np.repeat(np.linspace(0.1, 9.0, 30)[None], 20, axis=0), 2, axis=0).repeat(2, axis=1)
"""[h, w] DN per microsecond, alike over blocks."""
FLAT = np.random.default_rng(1).uniform(0.7, 1.0, SHAPE).astype(np.float32)


def picture(exposures_us: tuple[float, ...], gloss: NDArray[np.float64]) -> NDArray[np.float32]:
    """Of LEDs under which all looks the same, but for `gloss` [h, w], which the last one adds."""

    def frame(led: int, exposure_us: float) -> Any:
        light = RADIANCE + (gloss if led == LEDS[-1] else 0.0)
        raw = np.minimum(BLACK + light * FLAT * exposure_us, WHITE).round().astype(np.uint16)
        return SimpleNamespace(exposure_us=exposure_us, read=lambda: raw)

    view: Any = SimpleNamespace(name="top", by_led={led: [frame(led, us) for us in exposures_us] for led in LEDS})
    dark = np.full(SHAPE, BLACK, np.float32)
    radiometry: Any = SimpleNamespace(
        channel=np.zeros(SHAPE, np.int8), flat=FLAT, white_dn=WHITE, black_dn=BLACK, dark=lambda frame: dark
    )
    measured: Any = SimpleNamespace(channels=("G",))
    return matt_picture(measured, radiometry, view, LEDS, lambda step, done, of: None)


@pytest.mark.parametrize("exposures_us", [(300.0, 1500.0), (1500.0, 300.0)])
def test_parts_that_the_longest_exposure_clips_are_those_of_a_shorter_one(
    exposures_us: tuple[float, ...],
) -> None:
    made = picture(exposures_us, np.zeros(SHAPE))
    np.testing.assert_allclose(made, RADIANCE[::2, ::2], rtol=0.01)


def test_parts_that_all_exposures_clip_have_no_value() -> None:
    made, there = picture((1500.0,), np.zeros(SHAPE)), RADIANCE[::2, ::2]
    assert np.isnan(made[there * 1500 * 0.7 > WHITE - BLACK]).all()
    dark = there * 1500 < 0.97 * (WHITE - BLACK)
    np.testing.assert_allclose(made[dark], there[dark], rtol=0.01)


def test_gloss_that_clips_under_one_led_counts_as_brighter_than_the_ranks_used() -> None:
    made = picture((300.0,), np.full(SHAPE, 100.0))
    np.testing.assert_allclose(made, RADIANCE[::2, ::2], rtol=0.03)

"""How a view's samples are stored and batched."""

from __future__ import annotations

from types import SimpleNamespace

import numba
import numpy as np
import pytest

from coupole.reflectance.extraction import view_samples
from coupole.reflectance.extraction.view_samples import ViewPass


@numba.njit
def halves(numbers):  # type: ignore[no-untyped-def]
    found = np.empty(len(numbers), np.uint16)
    for n in range(len(numbers)):
        found[n] = view_samples._half_bits(numbers[n])
    return found


def test_halves_are_those_of_numpy() -> None:
    """From the smallest to the largest, ties, and what is none."""
    random = np.random.default_rng(1)
    numbers = np.exp(random.uniform(np.log(1e-8), np.log(6e4), 5000)).astype(np.float32)
    ties = (np.arange(2048, 4096) + 0.5).astype(np.float32)
    numbers = np.concatenate([numbers, -numbers, ties, [0.0, np.nan]]).astype(np.float32)
    np.testing.assert_array_equal(halves(numbers).view(np.float16), numbers.astype(np.float16))


@pytest.mark.parametrize(("leds", "exposures", "together"), [(6, 1, 6), (300, 1, 8), (300, 3, 2), (300, 20, 1)])
def test_leds_are_read_together_as_long_as_their_frames_are_few(leds: int, exposures: int, together: int) -> None:
    view = SimpleNamespace(by_led={led: [None] * exposures for led in range(leds)})
    assert ViewPass(None, view, None, None).together == together  # type: ignore[arg-type]

"""The slanted edge against a Gaussian blur of known width behind square pixels."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from coupole.calibration.colour.slanted_edge import slanted_edge
from coupole.errors import InputError

Array = NDArray[np.float64]
SIDE_PX = 60


def drawn_edge(
    blur_px: float, *, slant_deg: float = 5.0, shift_px: float = 0.0, bayer: bool = False, noise: float = 0.0
) -> tuple[Array, Array, Array]:
    """Pixels about an edge: a step behind a Gaussian blur, averaged over 8 x 8 places in each pixel."""
    angle = np.radians(slant_deg)
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX].astype(float)
    values = np.zeros_like(x)
    places = (np.arange(8) + 0.5) / 8 - 0.5
    for dx in places:
        for dy in places:
            away = (x + dx - 29.5) * np.cos(angle) + (y + dy - 29.5) * np.sin(angle) - shift_px
            values += ndtr(away / blur_px) / 64
    values = 0.1 + 0.8 * values + noise * np.random.default_rng(1).standard_normal(x.shape)
    green = (x + y) % 2 == 0 if bayer else np.ones_like(x, bool)
    return x[green], y[green], values[green]


@pytest.mark.parametrize("blur_px", [0.4, 0.7, 1.2])
@pytest.mark.parametrize("bayer", [False, True])
def test_the_response_is_the_closed_form(blur_px: float, bayer: bool) -> None:
    edge = slanted_edge(*drawn_edge(blur_px, bayer=bayer))
    f = edge.frequencies[edge.frequencies <= 0.5]
    angle = np.radians(5.0)
    pixel = np.sinc(f * np.cos(angle)) * np.sinc(f * np.sin(angle))
    wanted = np.exp(-2.0 * (np.pi * blur_px * f) ** 2) * pixel
    assert np.abs(edge.response[: len(f)] - wanted).max() < 0.02
    assert edge.frequency_at(0.5) == pytest.approx(np.interp(-0.5, -wanted, f), rel=0.03)


def test_a_shift_is_found_in_a_noisy_picture() -> None:
    still, shifted = (slanted_edge(*drawn_edge(0.7, shift_px=s, noise=0.01, bayer=True)) for s in (0.0, 0.2))
    assert shifted.offset_px - still.offset_px == pytest.approx(0.2, abs=0.02)


def test_edges_that_tell_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="turn the chart by about 5 degrees"):
        slanted_edge(*drawn_edge(0.7, slant_deg=0.3))
    x, y, _ = drawn_edge(0.7)
    with pytest.raises(InputError, match="between light and dark"):
        slanted_edge(x, y, np.ones_like(x))

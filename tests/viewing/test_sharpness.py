"""Sharpness in the live view is that of the picture, not of its noise."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from coupole.viewing.raw_preview import Coding, figures

BLACK_DN, ELECTRONS_PER_DN, READ_E = 64, 2.6, 6.0


@functools.cache
def scene_out_of_focus(blur_px: float) -> NDArray[np.float64]:
    """Leaves of all sizes, out of focus by `blur_px`."""
    drawn = np.random.default_rng(1)
    scene = np.ones((240, 320))
    y, x = np.mgrid[:240, :320]
    for radius in 40.0 / np.arange(1, 120):
        at = drawn.uniform(0, 240), drawn.uniform(0, 320)
        scene[np.hypot(y - at[0], x - at[1]) < radius] = drawn.uniform(0.1, 1.0)
    return gaussian_filter(scene, blur_px)


def frame(pattern: str, blur_px: float, peak_dn: float, seed: int) -> NDArray[np.uint16]:
    """A RAW frame with the noise of light and sensor."""
    light_e = scene_out_of_focus(blur_px) * peak_dn * ELECTRONS_PER_DN
    colours = {"R": 0.5, "G": 1.0, "B": 0.4, "M": 1.0}
    for place, letter in enumerate(pattern if pattern != "MONO" else "MMMM"):
        light_e[place // 2 :: 2, place % 2 :: 2] *= colours[letter]
    noise = np.random.default_rng(seed)
    seen_e = noise.poisson(light_e) + noise.normal(0.0, READ_E, light_e.shape)
    return np.clip(np.round(BLACK_DN + seen_e / ELECTRONS_PER_DN), 0, 4095).astype(np.uint16)


def sharpness(pattern: str, blur_px: float, peak_dn: float, seed: int = 2) -> float:
    return figures(frame(pattern, blur_px, peak_dn, seed), Coding(pattern, BLACK_DN, 4095)).sharpness


@pytest.mark.parametrize("pattern", ["GBRG", "RGGB", "MONO"])
def test_it_is_the_same_whatever_the_light_and_falls_with_blur(pattern: str) -> None:
    by_blur = [sharpness(pattern, blur, 3000.0) for blur in (0.7, 1.0, 1.5, 2.5, 5.0)]
    assert sorted(by_blur, reverse=True) == by_blur
    assert by_blur[0] > 4 * by_blur[-1]
    for peak_dn in (300.0, 60.0):
        seen = [sharpness(pattern, 1.0, peak_dn, seed) for seed in range(10)]
        assert np.mean(seen) == pytest.approx(by_blur[1], rel=0.05)


def test_dim_and_blurred_is_less_sharp_than_bright_and_sharp() -> None:
    assert sharpness("GBRG", 5.0, 30.0) < 0.5 * sharpness("GBRG", 0.7, 3000.0)


def test_without_light_there_is_none() -> None:
    assert [sharpness("GBRG", 1.0, 0.0, seed) for seed in range(20)] == [0.0] * 20

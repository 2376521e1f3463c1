"""Spots of lit LEDs in RAW frames: their centres, and what is not taken for one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from bright_squares import BLACK_DN, WHITE_DN, covered, defocused, raw, square
from synthesis import Array

from coupole.calibration.leds.spots import Spots, find_spots, outline_offsets

SHAPE = (160, 200)
LED = 3e4
"""Of an LED, in the unit of a white target: hundreds of times what the sensor holds."""


def frame(
    centres: list[tuple[float, float]],
    seed: int = 1,
    *,
    blur_px: float = 0.0,
    side_px: float = 30.0,
    glow: float = LED,
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    picture = sum((covered(SHAPE, square(np.array(c), side_px)) for c in centres), np.zeros(SHAPE))
    return raw(glow * defocused(picture, blur_px), np.random.default_rng(seed))


def spots(image: np.ndarray[tuple[int, ...], np.dtype[np.uint16]], pattern: str = "GBRG") -> Spots:
    return find_spots(image, float(BLACK_DN), pattern, WHITE_DN)


def off_by(pattern: str, blur_px: float, seeds: range) -> tuple[Array, Array]:
    """Errors [n, 2] and what is stated of them."""
    errors, sigmas = [], []
    for seed in seeds:
        random = np.random.default_rng(seed)
        centre = np.array([100.0, 80.0]) + random.uniform(-3, 3, 2)
        outline = square(centre, random.uniform(20, 36), random.uniform(0, 90), random.uniform(0.5, 1.0))
        picture = LED * defocused(covered(SHAPE, outline), blur_px)
        found = spots(raw(picture, random, pattern=pattern), pattern).good
        assert len(found) == 1
        errors.append(found[0].pixel - centre)
        sigmas.append(np.sqrt(np.diag(found[0].covariance)))
    return np.array(errors), np.array(sigmas)


@pytest.mark.parametrize("pattern", ["GBRG", "GRBG", "RGGB", "BGGR", "MONO"])
def test_the_centre_is_found_to_a_twentieth_of_a_pixel_whatever_the_pattern(pattern: str) -> None:
    errors, _ = off_by(pattern, 0.0, range(8))
    assert np.sqrt(np.mean(errors**2)) < 0.05


def test_a_blur_twice_as_wide_as_the_led_moves_no_centre() -> None:
    errors, _ = off_by("GBRG", 68.0, range(6))
    assert np.sqrt(np.mean(errors**2)) < 0.06


def test_the_stated_covariance_holds(scale: Callable[[int, int], int]) -> None:
    errors, sigmas = off_by("GBRG", 0.0, range(100, 100 + scale(40, 400)))
    normalised = np.sqrt(np.mean((errors / sigmas) ** 2))
    assert 0.3 < normalised < 1.1  # neighbours in a straight side may err alike, and need not


def test_a_dark_frame_gives_no_spot() -> None:
    image = frame([], glow=0.0)
    assert spots(image).good == ()
    assert spots(image).brightest < 0.05


def test_a_dim_led_gives_no_spot() -> None:
    assert spots(frame([(100, 80)], glow=0.2)).good == ()


def test_hot_pixels_are_no_spots() -> None:
    image = frame([])
    image[40, 40:43] = WHITE_DN
    assert spots(image).good == ()


def test_what_the_dark_frame_shows_too_is_no_spot() -> None:
    image, dark = frame([(100.0, 80.0)]), np.full(SHAPE, float(BLACK_DN))
    image[20:40, 20:40] = WHITE_DN
    dark[20:40, 20:40] = WHITE_DN
    assert len(find_spots(image, dark, "GBRG", WHITE_DN).good) == 1


def test_a_reflection_is_a_spot_of_its_own() -> None:
    found = spots(frame([(60.0, 80.0), (140.0, 80.0)])).good
    assert sorted(round(float(spot.pixel[0])) for spot in found) == [60, 140]


def test_a_spot_cut_by_the_edge_is_rejected() -> None:
    found = spots(frame([(190.0, 80.0)]))
    assert found.good == ()
    assert "cut by the frame's edge" in found.rejection_reasons[0]


def test_spots_that_touch_are_rejected() -> None:
    found = spots(frame([(80.0, 80.0), (112.0, 86.0)]))
    assert found.good == ()
    assert "not like a square" in found.rejection_reasons[0]


def test_a_streak_is_rejected() -> None:
    streak = covered(SHAPE, square(np.array([100.0, 80.0]), 120.0, 10.0, 0.05))
    found = spots(raw(LED * streak, np.random.default_rng(1)))
    assert found.good == ()
    assert "a streak" in found.rejection_reasons[0]


def test_perspective_within_an_led_moves_the_middle_of_its_outline_by_less_than_a_tenth_of_a_pixel() -> None:
    tilt = np.radians(60)
    pose = np.eye(4)[None].copy()
    pose[0, :3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    lens = np.array([7100.0, 7100.0, 2047.5, 1535.5, 0, 0, 0, 0, 0])
    off = outline_offsets(pose, np.array([[0.0, 0.0, 1000.0]]), np.eye(4)[None], lens, 7.0)
    assert 0.01 < np.abs(off[0, 0]) < 0.1
    assert np.abs(off[0, 1]) < 1e-9

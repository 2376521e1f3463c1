"""Corners drawn ray by ray, without the fit's formulas: each found to a hundredth of a pixel."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest
from corner_boards import Stratum, draw, with_noise
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from coupole.calibration.grey_image import Picture
from coupole.calibration.lens.corner_fit import Blur, Corners, fit_corners

SIZE_PX, RAYS, RADIUS_PX = 41, 32, 9.0
ALL = np.ones((1, 1), np.bool_)
GREEN = np.array([[True, False], [False, True]])
Floats = NDArray[np.float64]


def drawn(corner: Floats, first_deg: float, between_deg: float, *, blur_px: float = 0.0) -> Floats:
    """[h, w] of a corner at (x, y), 0 to 1, lit from one side: the mean of 32 x 32 rays in each pixel, on a grid
    that is turned a little, so that edges along the rows have no steps."""
    places = (np.arange(SIZE_PX * RAYS) + 0.5) / RAYS - 0.5
    shifts = ((np.arange(SIZE_PX * RAYS) % RAYS + 0.5) / RAYS - 0.5) / RAYS
    x, y = np.meshgrid(places - corner[0], places - corner[1])
    x, y = x + shifts[:, None], y - shifts[None, :]
    sides = [
        np.cos(np.radians(angle)) * y - np.sin(np.radians(angle)) * x > 0.0
        for angle in (first_deg, first_deg + between_deg)
    ]
    fine = np.where(sides[0] ^ sides[1], 0.1, 0.8) * (1.0 + 0.004 * x - 0.002 * y)
    if blur_px:
        fine = gaussian_filter(fine, blur_px * RAYS, mode="nearest")
    return np.asarray(fine.reshape(SIZE_PX, RAYS, SIZE_PX, RAYS).mean(axis=(1, 3)))


def random_corners(count: int) -> list[tuple[Floats, float, float]]:
    random = np.random.default_rng(5)
    return [
        (random.uniform(19.0, 21.0, 2), random.uniform(0.0, 360.0), random.uniform(50.0, 130.0))
        for _ in range(count)
    ]


@cache
def six_corners(blur_px: float) -> list[tuple[Floats, Floats]]:
    """Places and pictures."""
    return [(corner, drawn(corner, *angles, blur_px=blur_px)) for corner, *angles in random_corners(6)]


@pytest.mark.parametrize("known", [ALL, GREEN, ~GREEN], ids=["grey", "green", "greens-turned"])
@pytest.mark.parametrize("blur_px", [0.0, 0.6, 1.5])
def test_a_corner_is_found_to_a_few_thousandths_of_a_pixel(known: NDArray[np.bool_], blur_px: float) -> None:
    for corner, image in six_corners(blur_px):
        hidden = np.where(np.tile(known, (SIZE_PX, SIZE_PX))[:SIZE_PX, :SIZE_PX], image, 9.0)
        found = fit_corners(hidden, known, np.array([[20.0, 20.0]]), RADIUS_PX)
        assert found.fits.all()
        assert np.abs(found.pixels[0] - corner).max() < (0.001 if blur_px else 0.006)


@pytest.mark.parametrize("first_deg", [0.0, 45.0, 90.0])
def test_edges_along_rows_and_diagonals_are_no_harder(first_deg: float) -> None:
    errors = []
    for share in np.linspace(0.0, 0.9, 10):
        corner = np.array([20.0 + share, 20.3 - share])
        found = fit_corners(drawn(corner, first_deg, 90.0), ALL, np.array([[20.0, 20.0]]), RADIUS_PX)
        errors.append(found.pixels[0] - corner)
    assert np.abs(errors).max() < 0.01


def test_a_start_two_pixels_off_leads_to_the_same_corner() -> None:
    corner = np.array([20.3, 19.6])
    starts = corner + np.array([[0.0, 0.0], [2.0, 0.0], [0.0, -2.0], [1.4, 1.4]])
    found = fit_corners(drawn(corner, 20.0, 80.0), ALL, starts, RADIUS_PX)
    assert found.fits.all()
    assert np.abs(found.pixels - corner).max() < 0.01


def test_noise_does_less_harm_than_to_opencvs_corners() -> None:
    random = np.random.default_rng(7)
    ours, opencvs = [], []
    for corner, first_deg, between_deg in random_corners(20):
        image = drawn(corner, first_deg, between_deg) + random.normal(0.0, 0.02, (SIZE_PX, SIZE_PX))
        start = np.array([[20.0, 20.0]])
        ours.append(fit_corners(image, ALL, start, RADIUS_PX).pixels[0] - corner)
        until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
        points = start.astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix((255.0 * image).astype(np.float32), points, (9, 9), (-1, -1), until)
        opencvs.append(found.reshape(2) - corner)
    assert np.std(ours) < 0.5 * np.std(opencvs)


def test_blur_is_told() -> None:
    corner = np.array([20.2, 20.4])
    found = [
        fit_corners(drawn(corner, 30.0, 85.0, blur_px=blur_px), ALL, corner[None], RADIUS_PX).sigma_px[0]
        for blur_px in (0.4, 0.8, 1.6)
    ]
    assert found == pytest.approx([0.4, 0.8, 1.6], rel=0.01)
    assert all(finer < coarser for finer, coarser in pairwise(found))


def test_what_is_no_corner_is_not_taken_for_one() -> None:
    x, y = np.meshgrid(np.arange(SIZE_PX), np.arange(SIZE_PX))
    flat, edge = np.ones((SIZE_PX, SIZE_PX)), (x + 0.3 * y > 25).astype(float)
    blob = np.exp(-((x - 20) ** 2 + (y - 20) ** 2) / 18.0)
    noise = np.random.default_rng(1).normal(size=(SIZE_PX, SIZE_PX))
    for image in (flat, edge, blob, noise):
        found = fit_corners(image, ALL, np.array([[20.0, 20.0]]), RADIUS_PX)
        assert not found.fits.any()
        assert np.array_equal(found.pixels, [[20.0, 20.0]])


STARTS_OFF = 0.5
ELLIPSE = Stratum("elliptic blur", blur="ellipse 1.4 0.6", tilt_deg=55.0)
COMA = Stratum("coma", blur="streak 3")
GREY = Stratum("grey")


def of_board(
    stratum: Stratum, values: Floats, corners: Floats, blur: Blur = "own", radius_px: float = 4.5
) -> Corners:
    pixels, mask = Picture(values, stratum.pattern, 4095.0).values_and_mask("green")
    return fit_corners(pixels, mask, corners + STARTS_OFF, radius_px, blur=blur)


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_an_elliptic_blur_shifts_no_corner() -> None:
    """With one round blur it does, where the board is tilted."""
    board = draw(ELLIPSE, 1)
    own, same = (of_board(ELLIPSE, board.values, board.corners, blur) for blur in ("own", "round"))
    assert own.fits.all()
    assert same.fits.all()
    assert rms(own.pixels - board.corners) < 0.001
    assert rms(same.pixels - board.corners) > 0.005


def test_most_of_the_shift_by_coma_is_undone() -> None:
    board = draw(COMA, 1)
    own, same = (of_board(COMA, board.values, board.corners, blur, 8.0) for blur in ("own", "round"))
    left, before = rms(own.pixels - board.corners), rms(same.pixels - board.corners)
    assert left < 0.3 * before


def test_noise_is_not_taken_for_coma() -> None:
    """Corners alone are too few for coma to be looked for: those of a clean board are the same."""
    clean = draw(GREY, 1)
    values = with_noise(clean.values, 1)
    together = of_board(GREY, values, clean.corners)
    few = [of_board(GREY, values, clean.corners[first : first + 9]).pixels for first in range(0, 36, 9)]
    assert np.abs(np.concatenate(few) - together.pixels).max() < 1e-6


@pytest.mark.parametrize("stratum", [GREY, Stratum("green", pattern="GBRG"), ELLIPSE, COMA])
def test_the_stated_uncertainty_of_a_corner_holds(stratum: Stratum) -> None:
    over_u = []
    board = draw(stratum, 2)
    for seed in range(3):
        found = of_board(stratum, with_noise(board.values, seed), board.corners)
        factor = np.linalg.cholesky(found.covariance_px2[found.fits])
        over_u.append(np.linalg.solve(factor, (found.pixels - board.corners)[found.fits][..., None]))
    assert 0.8 < rms(np.concatenate(over_u)) < 1.25


def test_the_uncertainty_grows_with_the_noise() -> None:
    board = draw(GREY, 3)
    quiet, loud = (
        of_board(
            GREY,
            board.values + np.random.default_rng(1).normal(0.0, noise_dn, board.values.shape),
            board.corners,
        )
        for noise_dn in (20.0, 80.0)
    )
    ratio = np.sqrt(np.trace(loud.covariance_px2.mean(axis=0)) / np.trace(quiet.covariance_px2.mean(axis=0)))
    assert ratio == pytest.approx(4.0, rel=0.1)

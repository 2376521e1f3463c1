"""The lens from images of a board: near the truth, and as near as it says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from synthesis import make_cell

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.lens.camera import calibrate_camera, without_gross_errors
from coupole.calibration.optics import MODELS
from coupole.errors import InputError


def test_stated_intervals_cover_the_true_lens(scale: Callable[[int, int], int]) -> None:
    cells = scale(24, 200)
    normalised, covered = [], []
    for seed in range(cells):
        cell = make_cell(1000 + seed, images=scale(10, 30))
        fit = calibrate_camera(cell.sightings, cell.size_px)
        error = fit.intrinsics.vector() - cell.lens.vector()
        u = np.sqrt(np.diag(fit.covariance))
        normalised.append(error / u)
        covered.append(np.abs(error) <= coverage_factor(fit.degrees) * u)
    assert 0.90 <= np.mean(covered) <= 0.99
    if cells >= 100:
        each = np.mean(covered, axis=0)
        assert np.all((each >= 0.90) & (each <= 0.99)), each
        ratio = np.sqrt(np.mean(np.square(normalised), axis=0))
        assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio


def test_the_noise_of_corners_is_found() -> None:
    cell = make_cell(1, pixel_px=0.23)
    assert calibrate_camera(cell.sightings, cell.size_px).sigma_px == pytest.approx(0.23, rel=0.05)


def test_gross_errors_are_left_out_and_change_nothing() -> None:
    cell = make_cell(2, images=12)
    spoilt = list(cell.sightings)
    for image, corner, shift_px in ((3, 5, 3.0), (3, 9, -40.0), (7, 11, 8.0)):
        pixels = spoilt[image].pixels.copy()
        pixels[corner] += shift_px
        spoilt[image] = replace(spoilt[image], pixels=pixels)
    clean, fit = (calibrate_camera(seen, cell.size_px) for seen in (cell.sightings, spoilt))
    assert [(int(i), np.flatnonzero(~k).tolist()) for i, k in enumerate(fit.accepted_masks) if not k.all()] == [
        (3, [5, 9]),
        (7, [11]),
    ]
    moved = fit.intrinsics.vector() - clean.intrinsics.vector()
    assert np.all(np.abs(moved) < 0.5 * np.sqrt(np.diag(clean.covariance)))
    assert sum(len(s.ids) for s in without_gross_errors(fit)) == sum(len(s.ids) for s in cell.sightings) - 3


@pytest.mark.parametrize("model", MODELS)
def test_parameters_that_are_not_free_stay_nought(model: str) -> None:
    cell = make_cell(3, images=10, distorted=False)
    fit = calibrate_camera(cell.sightings, cell.size_px, model)
    held = [name for name in MODELS["brown5"] if name not in MODELS[model]]
    assert all(getattr(fit.intrinsics, name) == 0.0 for name in held)
    assert fit.covariance.shape == (len(MODELS[model]),) * 2


def test_too_few_images_are_refused() -> None:
    cell = make_cell(4, images=3)
    with pytest.raises(InputError, match="3 usable images"):
        calibrate_camera(cell.sightings, cell.size_px)


def test_images_that_are_all_alike_are_refused() -> None:
    cell = make_cell(5, images=1)
    with pytest.raises(InputError, match="differ more in tilt"):
        calibrate_camera(cell.sightings * 6, cell.size_px)

"""What views of a panel say of causes that a plain flat field lacks."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from coupole.calibration.light.flat_field import FlatField, fit_flat_field
from coupole.calibration.light.flat_field_records import limits_of
from coupole.calibration.light.flat_suspects import FORM, PANEL

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from drawn_panels import FOCAL_PX, SIZE_PX, draw_field
from prove_flat_field import Judged, judge_cell


@cache
def judged(cause: str, strength: float, seed: int = 1) -> Judged:
    return judge_cell(seed, cause, strength)


def fitted(cause: str, strength: float) -> FlatField:
    views = draw_field(1, cause, strength).views
    return fit_flat_field(views, channel="G", focal_px=1.02 * FOCAL_PX, size_px=SIZE_PX)


@pytest.mark.parametrize(
    ("cause", "strength", "name"), [("panel", 0.001, PANEL), ("oval", 0.01, FORM), ("slant", 0.01, FORM)]
)
def test_intervals_hold_with_a_cause_and_it_is_named(cause: str, strength: float, name: str) -> None:
    cells = [judged(cause, strength, seed) for seed in (1, 2, 3)]
    assert np.mean([cell.plain.share for cell in cells]) < 0.75
    assert np.mean([cell.ours.share for cell in cells]) > 0.85
    assert all(cell.named_suspects == (name,) for cell in cells)


def test_without_a_cause_none_is_named_and_uncertainties_stay_as_they_are() -> None:
    cells = [judged("panel", 0.0, seed) for seed in (1, 2, 3)]
    assert not [name for cell in cells for name in cell.named_suspects]
    assert np.median([cell.ours.u / cell.plain.u for cell in cells]) < 1.1


@pytest.mark.parametrize(
    ("cause", "strength", "what"),
    [("panel", 0.02, "pattern of the panel"), ("oval", 0.2, "fall-off that is not round")],
)
def test_a_cause_that_is_too_large_misses_its_limit(cause: str, strength: float, what: str) -> None:
    assert what in judged(cause, strength).missed_limits
    assert not judged("panel", 0.0).missed_limits


def test_the_map_has_the_part_that_is_not_round() -> None:
    fit = fitted("oval", 0.03)
    pixels = np.array([[[0.0, 0.0], [1023.0, 0.0]], [[0.0, 767.0], [500.0, 300.0]]])
    columns, rows = pixels[..., 0].astype(int), pixels[..., 1].astype(int)
    assert fit.map()[rows, columns] == pytest.approx(fit.at(pixels), rel=1e-6)
    true = draw_field(1, "oval", 0.03).falloff
    corners = np.array([[0.0, 0.0], [1023.0, 0.0], [0.0, 767.0], [1023.0, 767.0]])
    error = np.log(fit.at(corners) / true(corners))
    assert np.std(error) < 0.002
    assert next(iter(fit.causes.sentences())).startswith("the fall-off is not round")
    assert limits_of({"G": fit}, (), SIZE_PX)[-1].found == pytest.approx(fit.causes.off_round)

"""Model error from the structure of residuals: by closed forms, and on cells that a fit has no term for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthesis import Cell, TrueLens, board_points, looking_at_board, make_cell

from coupole.calibration.adjustment import Block
from coupole.calibration.cross_validation import left_out
from coupole.calibration.lens.board import Sighting
from coupole.calibration.lens.camera import CameraCalibration, calibrate_camera
from coupole.calibration.lens.suspects import BOARD, FOCUS, LENS, PRINT, PRINT_UNIT, Field
from coupole.calibration.model_error import Search, Suspect, with_suspects

GROUPS, EACH = 30, 12


def one_mean(values: np.ndarray) -> Block:
    """Observations of one unknown mean, each with the stated noise 1."""
    return Block(values, np.ones((len(values), 1)), np.array([0]), 0)


def grouped(between: float, seed: int = 1) -> np.ndarray:
    random = np.random.default_rng(seed)
    return (random.normal(0, between, GROUPS)[:, None] + random.normal(0, 0.5, (GROUPS, EACH))).ravel()


def test_amplitude_and_uncertainty_are_those_of_the_analysis_of_variance() -> None:
    """Balanced one-way random effects, for which REML is ANOVA (Searle, Variance Components, 1992)."""
    values = grouped(0.4)
    values -= values.mean()
    table = values.reshape(GROUPS, EACH)
    between = EACH * np.sum(table.mean(axis=1) ** 2) / (GROUPS - 1)
    within = np.sum((table - table.mean(axis=1, keepdims=True)) ** 2) / (GROUPS * (EACH - 1))
    suspect = Suspect("groups", np.repeat(np.eye(GROUPS), EACH, axis=0))
    weights = [np.ones(len(values))]
    found = with_suspects(
        [one_mean(values)], weights, np.array([values.std(ddof=1)]), 1, len(values) - 1, [suspect]
    )
    assert found.noise**2 == pytest.approx(within, rel=0.01)
    assert found.of("groups").amplitude ** 2 == pytest.approx((between - within) / EACH, rel=0.02)
    assert found.covariance[0, 0] == pytest.approx(between / len(values), rel=0.02)
    assert found.of("groups").evidence > 50


def test_a_suspect_explains_why_a_parameter_is_far_from_its_prior() -> None:
    """Two unknown levels of 0 within 0.1, both seen at 3: either both are 30 sigma off, or all values are."""
    random = np.random.default_rng(2)
    levels = np.repeat(np.eye(2), 40, axis=0)
    values = 3.0 + random.normal(0, 1.0, 80)
    blocks = [Block(values, levels, np.arange(2), 0), Block(np.zeros(2), np.eye(2) / 0.1, np.arange(2), 1)]
    suspects = [Suspect("all", np.ones((80, 1))), Suspect("alternating", np.tile([1.0, -1.0], 40)[:, None])]
    found = with_suspects(
        blocks, [np.ones(80), np.ones(2)], np.ones(2), 2, 80.0, suspects, Search(priors=(1,), doubtful=1.64)
    )
    assert found.of("all").evidence > 50
    assert found.of("all").coefficients[0] == pytest.approx(values.mean(), abs=0.3)
    assert np.abs(found.step).max() < 0.3
    assert found.of("alternating").amplitude < 1e-6
    assert found.noise == pytest.approx(1.0, abs=0.15)
    assert found.joint_covariance[:2, :2] == pytest.approx(found.covariance)
    both = found.joint_covariance[0, 0] + found.joint_covariance[2, 2] + 2 * found.joint_covariance[0, 2]
    assert both == pytest.approx(1.0 / 80, rel=0.7)


def test_noise_without_structure_gives_a_suspect_neither_evidence_nor_weight() -> None:
    values = grouped(0.0)
    values -= values.mean()
    suspect = Suspect("groups", np.repeat(np.eye(GROUPS), EACH, axis=0))
    found = with_suspects(
        [one_mean(values)], [np.ones(len(values))], np.array([0.5]), 1, len(values) - 1, [suspect]
    )
    assert found.of("groups").evidence < 4
    assert found.covariance[0, 0] == pytest.approx(0.25 / len(values), rel=0.3)


def test_views_left_out_are_predicted_as_by_a_fit_without_them() -> None:
    random = np.random.default_rng(4)
    design, values = random.normal(size=(24, 3)), random.normal(size=24)
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    parts = [slice(4 * n, 4 * n + 4) for n in range(6)]
    blocks = [Block((values - design @ solution)[part], design[part], np.arange(3), 0) for part in parts]
    covariance = np.linalg.inv(design.T @ design)
    found = left_out([[n] for n in range(6)], blocks, [np.ones(4)] * 6, np.ones(1), covariance)
    for number, part in enumerate(parts):
        rest = np.delete(np.arange(24), np.arange(24)[part])
        without = np.linalg.lstsq(design[rest], values[rest], rcond=None)[0]
        off = values[part] - design[part] @ without
        spread = np.eye(4) + design[part] @ np.linalg.inv(design[rest].T @ design[rest]) @ design[part].T
        assert found.off[number] == pytest.approx(np.sqrt(np.mean(off**2)))
        assert found.ratios[number] == pytest.approx(np.sqrt(off @ np.linalg.solve(spread, off) / 4))


# -- cells ----------------------------------------------------------------------------------------------------


def with_pattern(cell: Cell, shift_px: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Cell:
    """The cell with its corners shifted by a function of pixels and places on the board."""
    moved = [replace(one, pixels=one.pixels + shift_px(one.pixels, one.board_mm)) for one in cell.sightings]
    return replace(cell, sightings=tuple(moved))


def test_a_cell_of_the_model_s_form_raises_no_doubt() -> None:
    cell = make_cell(31, images=16)
    plain, fit = (calibrate_camera(cell.sightings, cell.size_px, with_doubts=doubted) for doubted in (False, True))
    assert fit.doubts is not None
    assert max(one.evidence for one in fit.doubts.error.suspects) < 10
    assert fit.doubts.predictions.ratio == pytest.approx(1.0, abs=0.1)
    assert fit.doubts.pattern < 0.5
    assert fit.sigma_px == pytest.approx(plain.sigma_px, rel=0.02)
    assert np.median(np.diag(fit.covariance) / np.diag(plain.covariance)) ** 0.5 < 1.15


def test_a_lens_of_another_form_is_named_and_refused_by_its_pattern() -> None:
    cell = make_cell(32, images=16)

    def wavy(pixels: np.ndarray, board_mm: np.ndarray) -> np.ndarray:
        return 0.5 * np.sin(7.0 * pixels[:, ::-1] / cell.size_px[0])

    fit = calibrate_camera(with_pattern(cell, wavy).sightings, cell.size_px, with_doubts=True)
    assert fit.doubts is not None
    evidence = {one.name: one.evidence for one in fit.doubts.error.suspects}
    assert max(evidence, key=lambda name: evidence[name]) == LENS
    assert evidence[LENS] > 100 > evidence[BOARD]
    assert fit.doubts.pattern > 1.0
    assert any("form that its model lacks" in line for line in fit.doubts.sentences())
    field = Field.of(fit.intrinsics.vector(), fit.free, cell.size_px)
    assert np.abs(field.modes(field.grid_px()).T @ field._own_derivatives(field.grid_px())).max() < 1e-4


def test_a_focal_length_that_changes_from_view_to_view_is_named() -> None:
    cell, random = make_cell(33, images=16), np.random.default_rng(3)
    middle = np.array(cell.size_px) / 2

    def breathing(pixels: np.ndarray, board_mm: np.ndarray) -> np.ndarray:
        return 3e-3 * random.standard_normal() * (pixels - middle)

    fit = calibrate_camera(with_pattern(cell, breathing).sightings, cell.size_px, with_doubts=True)
    assert fit.doubts is not None
    evidence = {one.name: one.evidence for one in fit.doubts.error.suspects}
    assert max(evidence, key=lambda name: evidence[name]) == FOCUS
    assert evidence[FOCUS] > 20


def with_print(cell: Cell, wider: float) -> Cell:
    """The cell of a board that is `wider` than its description says, as a share of its width."""
    as_described = [
        replace(one, board_mm=one.board_mm / np.array([1.0 + wider, 1.0, 1.0])) for one in cell.sightings
    ]
    return replace(cell, sightings=tuple(as_described))


@pytest.mark.parametrize("wider", [0.006, -0.002])
def test_a_board_that_is_wider_than_high_is_named_and_fitted(wider: float) -> None:
    cell = with_print(make_cell(35, images=20), wider)
    plain, fit = (calibrate_camera(cell.sightings, cell.size_px, with_doubts=doubted) for doubted in (False, True))
    assert fit.doubts is not None
    evidence = {one.name: one.evidence for one in fit.doubts.error.suspects}
    assert max(evidence, key=lambda name: evidence[name]) == PRINT
    suspect = fit.doubts.error.of(PRINT)
    u = PRINT_UNIT * np.sqrt(suspect.coefficient_covariance[0, 0])
    assert PRINT_UNIT * suspect.coefficients[0] == pytest.approx(wider, abs=3 * u + 0.02 * abs(wider))
    off = [(one.intrinsics.vector() - cell.lens.vector())[:2] for one in (plain, fit)]
    assert np.abs(off[1]).max() < 0.3 * np.abs(off[0]).max()
    assert np.all(np.abs(off[1]) < 3 * np.sqrt(np.diag(fit.covariance))[:2])
    words = "wider than high" if wider > 0 else "higher than wide"
    assert any(words in line for line in fit.doubts.sentences())


def test_of_a_printed_board_the_lens_is_that_of_opencv_s_calibration_that_frees_the_board() -> None:
    """`calibrateCameraRO` (Strobl and Hirzinger 2011) needs all corners in all views, and adjusts their places."""
    lens = make_cell(36).lens
    sightings, random = whole_boards(lens, 20), np.random.default_rng(5)
    described = board_points() / np.array([1.006, 1.0, 1.0])
    seen = [replace(one, board_mm=described) for one in sightings]
    seen = [replace(one, pixels=one.pixels + random.normal(0.0, 0.05, one.pixels.shape)) for one in seen]
    fit = calibrate_camera(seen, (1024, 768), with_doubts=True)
    released = cv2.calibrateCameraRO(
        [described.astype(np.float32)] * len(seen),
        [one.pixels.astype(np.float32) for one in seen],
        (1024, 768), 10, np.eye(3), np.zeros(5),
    )[1]  # fmt: skip
    u = np.sqrt(np.diag(fit.covariance))[:2]
    ours, theirs = fit.intrinsics.vector()[:2], np.array([released[0, 0], released[1, 1]])
    plain = calibrate_camera(seen, (1024, 768)).intrinsics.vector()[:2]
    assert np.all(np.abs(ours - theirs) < 3 * u + 0.3)
    assert np.abs(plain - theirs).max() > 3 * np.abs(ours - theirs).max()


def whole_boards(lens: TrueLens, images: int) -> list[Sighting]:
    """Sightings in which every corner is inside the field, without noise."""
    random, points, sightings = np.random.default_rng(4), board_points(), []
    while len(sightings) < images:
        board_from_camera = looking_at_board(random, points.max(axis=0)[:2], 480.0)
        pixels = lens.see((points - board_from_camera[:3, 3]) @ board_from_camera[:3, :3])
        if np.all((pixels > 4) & (pixels < (1020, 764))):
            sightings.append(Sighting(f"image {len(sightings)}", np.arange(len(points)), points, pixels))
    return sightings


def test_a_bent_board_is_named_and_no_longer_bends_the_lens() -> None:
    """0.2 mm, with corners shifted as OpenCV projects them; without a term for it the lens is off by many u."""
    cell = make_cell(34, images=20, pixel_px=0.02)
    flat = calibrate_camera(cell.sightings, cell.size_px)
    lens = flat.intrinsics
    bent = []
    for one, pose in zip(cell.sightings, flat.camera_from_board, strict=True):
        places = 2 * (one.board_mm[:, 0] - one.board_mm[:, 0].mean()) / np.ptp(cell.sightings[0].board_mm[:, 0])
        raised = one.board_mm + np.outer(0.2 * (1 - places**2), (0, 0, 1))
        turn = cv2.Rodrigues(pose[:3, :3])[0]
        there, here = (
            cv2.projectPoints(points, turn, pose[:3, 3], lens.matrix(), lens.distortion())[0][:, 0]
            for points in (raised, one.board_mm)
        )
        bent.append(replace(one, pixels=one.pixels + there - here))

    def off(fit: CameraCalibration) -> float:
        moved = fit.intrinsics.vector() - flat.intrinsics.vector()
        return float(np.sqrt(moved @ np.linalg.solve(fit.covariance, moved) / len(moved)))

    plain, fit = (calibrate_camera(bent, cell.size_px, with_doubts=doubted) for doubted in (False, True))
    assert fit.doubts is not None
    evidence = {one.name: one.evidence for one in fit.doubts.error.suspects}
    assert max(evidence, key=lambda name: evidence[name]) == BOARD
    assert off(plain) > 3.0
    assert off(fit) < 1.5
    assert any("not flat" in line for line in fit.doubts.sentences())

"""Hand-eye in closed form and by bundle adjustment: near the truth, and as near as they say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from synthesis import Array, Cell, frame, make_cell

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.lens.bundle import HandEyeCalibration, RobotNoise, calibrate_hand_eye
from coupole.calibration.lens.camera import calibrate_camera, without_gross_errors
from coupole.calibration.lens.equations import EarlierLens, Poses
from coupole.calibration.lens.hand_eye import METHODS, motions, solve
from coupole.calibration.rotations import between
from coupole.errors import InputError

TO_UNITS = np.array([1, 1, 1, *np.degrees([1, 1, 1])])
OPENCV = {"Park": "PARK", "Daniilidis": "DANIILIDIS", "Tsai": "TSAI"}


def exact_poses(seed: int, count: int = 12) -> tuple[Array, Array, Array, Array]:
    """base_from_flange, camera_from_board [n, 4, 4] without noise, flange_from_camera, base_from_board."""
    random = np.random.default_rng(seed)
    hand_eye = frame(random.uniform(-90, 90, 3), random.uniform(-100, 100, 3))
    board = frame(random.uniform(-300, 300, 3), random.uniform(-100, 100, 3))
    flange = np.stack([frame(random.uniform(-400, 400, 3), random.uniform(-60, 60, 3)) for _ in range(count)])
    return flange, np.linalg.inv(flange @ hand_eye) @ board, hand_eye, board


def calibrated(cell: Cell, poses: Poses | None = None, **options: object) -> HandEyeCalibration:
    fit = calibrate_camera(cell.sightings, cell.size_px)
    return calibrate_hand_eye(
        without_gross_errors(fit),
        poses or Poses(cell.base_from_flange),
        lens=fit.intrinsics,
        robot=RobotNoise(),
        **options,  # type: ignore[arg-type]
    )


def errors_of(cell: Cell, found: HandEyeCalibration) -> Array:
    """Found minus true, in the order and units of the names."""
    return np.concatenate(
        [
            found.intrinsics.vector() - cell.lens.vector(),
            -between(found.flange_from_camera, cell.flange_from_camera) * TO_UNITS,
            -between(found.base_from_board, cell.base_from_board) * TO_UNITS,
        ]
    )


@pytest.mark.parametrize("name", METHODS)
def test_each_method_solves_exact_motions_exactly(name: str) -> None:
    for seed in range(5):
        flange, camera, hand_eye, board = exact_poses(seed)
        found = solve(flange, camera, METHODS[name])
        assert np.allclose(found.flange_from_camera, hand_eye, atol=1e-8)
        assert np.allclose(found.base_from_board, board, atol=1e-7)
        assert found.scatter_mm < 1e-6


@pytest.mark.parametrize("name", METHODS)
def test_each_method_agrees_with_opencvs(name: str) -> None:
    import cv2

    cell = make_cell(0)
    camera = calibrate_camera(cell.sightings, cell.size_px).camera_from_board
    ours = solve(cell.base_from_flange, camera, METHODS[name]).flange_from_camera
    turn, shift = cv2.calibrateHandEye(
        *([t[:3, :3] for t in cell.base_from_flange], [t[:3, 3] for t in cell.base_from_flange]),
        *([t[:3, :3] for t in camera], [t[:3, 3] for t in camera]),
        method=getattr(cv2, f"CALIB_HAND_EYE_{OPENCV[name]}"),
    )
    assert np.abs(ours[:3, 3] - shift.ravel()).max() < 0.03  # OpenCV takes half the pairs, and scales them
    assert np.abs(ours[:3, :3] - turn).max() < 2e-4


def test_poses_that_turn_about_one_axis_only_are_refused() -> None:
    flange = np.stack([frame(np.array([50.0 * i, 0, 0]), np.array([0, 0, 12.0 * i])) for i in range(8)])
    camera = np.linalg.inv(flange @ frame(np.array([10.0, 20, 30]), np.array([0, 0, 45.0])))
    with pytest.raises(InputError, match="about one axis only"):
        motions(flange, camera)


def test_stated_intervals_cover_the_truth_for_every_parameter(scale: Callable[[int, int], int]) -> None:
    cells = scale(10, 200)
    normalised, covered = [], []
    for seed in range(cells):
        cell = make_cell(seed, images=scale(15, 30))
        found = calibrated(cell)
        ratio = errors_of(cell, found) / np.sqrt(np.diag(found.covariance))
        normalised.append(ratio)
        covered.append(np.abs(ratio) <= coverage_factor(found.degrees))
    assert 0.90 <= np.mean(covered) <= 0.99
    assert 0.8 < np.sqrt(np.mean(np.square(normalised))) < 1.25
    if cells >= 100:
        each, spread = np.mean(covered, axis=0), np.sqrt(np.mean(np.square(normalised), axis=0))
        assert np.all((each >= 0.90) & (each <= 0.99)), dict(zip(found.names, each, strict=True))
        assert np.all((spread > 0.8) & (spread < 1.25)), dict(zip(found.names, spread, strict=True))


def test_noise_of_corners_and_robot_is_told_apart() -> None:
    found = calibrated(make_cell(7, images=40, pixel_px=0.15, robot_mm=0.2, robot_deg=0.02))
    assert found.noise.pixel_px == pytest.approx(0.15, rel=0.05)
    assert found.noise.position_mm == pytest.approx(0.2, rel=0.25)
    assert found.noise.orientation_deg == pytest.approx(0.02, rel=0.25)


def test_the_shares_of_each_variance_add_up() -> None:
    found = calibrated(make_cell(8, images=12), board_scale_u_ppm=100.0)
    assert np.allclose(found.shares.sum(axis=0), 1.0)
    assert np.allclose(found.covariance, found.covariance.T)


def test_errors_of_axes_zeros_are_found_where_axes_are_known() -> None:
    cell = make_cell(9, images=40, robot_mm=0.03, robot_deg=0.003)
    random = np.random.default_rng(9)
    sensitivity = np.concatenate([random.normal(0, 8, (40, 3, 6)), random.normal(0, 0.012, (40, 3, 6))], axis=1)
    zeros_deg = random.normal(0, 0.02, 6)
    steps = sensitivity @ zeros_deg
    wrong = np.stack([frame(s[:3], np.degrees(s[3:])) for s in steps])
    poses = Poses(cell.base_from_flange @ np.linalg.inv(wrong), sensitivity)
    found = calibrated(cell, poses)
    u = np.array([found.u(f"axis_zero.a{axis}_deg") for axis in range(1, 7)])
    assert np.all(np.abs(found.axis_zeros_deg - zeros_deg) < 3.5 * u)
    assert np.all(u < 0.01)
    assert found.noise.position_mm < 0.06


def test_a_lens_that_is_known_already_is_held() -> None:
    cell = make_cell(10, images=12)
    lens = calibrate_camera(cell.sightings, cell.size_px)
    exact = calibrate_hand_eye(
        cell.sightings, Poses(cell.base_from_flange), lens=EarlierLens(lens.intrinsics), robot=RobotNoise()
    )
    assert exact.intrinsics == lens.intrinsics
    assert len(exact.names) == 12
    earlier = EarlierLens(lens.intrinsics, lens.free, lens.covariance)
    improved = calibrate_hand_eye(cell.sightings, Poses(cell.base_from_flange), lens=earlier, robot=RobotNoise())
    assert np.all(np.diag(improved.covariance)[:9] < np.diag(lens.covariance))


def test_images_and_poses_that_differ_in_number_are_refused() -> None:
    cell = make_cell(11, images=8)
    with pytest.raises(InputError, match="8 images and 7 poses"):
        calibrated(cell, Poses(cell.base_from_flange[:7]))

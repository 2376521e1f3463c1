"""Contradictions between robot and camera are detected and their cause is named."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthesis import Array, Cell, frame, make_cell

from coupole.calibration.lens import hypotheses
from coupole.calibration.lens.camera import calibrate_camera
from coupole.calibration.lens.diagnosis import Diagnosis, diagnose, expected_scatter
from coupole.calibration.poses import Convention, ReportedPoses, kuka_poses

IMAGES = 14


@cache
def seen() -> tuple[Cell, Array]:
    """A cell, and the board as its camera saw it [n, 4, 4]."""
    cell = make_cell(21, images=IMAGES)
    return cell, calibrate_camera(cell.sightings, cell.size_px).camera_from_board


def judged(poses: ReportedPoses, camera_from_board: Array | None = None) -> Diagnosis:
    cell, board = seen()
    board = board if camera_from_board is None else camera_from_board
    expected = expected_scatter(
        seen()[1], pixel_px=0.1, focal_px=cell.lens.focal_px[0], robot_mm=0.05, robot_deg=0.005
    )
    return diagnose(poses, board, expected, [f"image {i}" for i in range(len(board))])


def numbers(rotation: str = "abc") -> Array:
    """The cell's poses in mm and degrees."""
    flange = seen()[0].base_from_flange
    turns = Rotation.from_matrix(flange[:, :3, :3])
    angles = {
        "abc": lambda: turns.as_euler("ZYX", degrees=True),
        "xyz": lambda: turns.as_euler("XYZ", degrees=True),
        "rotation_vector": lambda: np.degrees(turns.as_rotvec()),
    }[rotation]()
    return np.hstack([flange[:, :3, 3], angles])


def test_true_poses_raise_no_alarm() -> None:
    found = judged(kuka_poses(seen()[0].base_from_flange))
    assert not found.contradicts
    assert found.sentences() == ()


@pytest.mark.parametrize("said", ["mm", "m"])
def test_positions_in_another_unit_are_named(said: str) -> None:
    poses = numbers()
    poses[:, :3] *= 1e-3 if said == "mm" else 1.0  # what is said is wrong
    found = judged(ReportedPoses(poses, Convention(length_unit=said)))
    assert found.cause == hypotheses.UNITS
    assert f"positions are in {'m' if said == 'mm' else 'mm'}, not {said}" in found.sentences()[1]


def test_a_board_described_in_metres_is_named() -> None:
    board = seen()[1].copy()
    board[:, :3, 3] *= 1e-3
    found = judged(kuka_poses(seen()[0].base_from_flange), board)
    assert "squares are given in m, not mm" in found.sentences()[1]


@pytest.mark.parametrize("rotation", ["abc", "rotation_vector"])
def test_radians_taken_for_degrees_and_the_other_way_are_named(rotation: str) -> None:
    poses = numbers(rotation)
    said_rad = ReportedPoses(poses, Convention(rotation=rotation, angle_unit="rad"))
    assert "angles are in degrees, not radians" in judged(said_rad).sentences()[1]
    radians = np.hstack([poses[:, :3], np.radians(poses[:, 3:])])
    said_deg = ReportedPoses(radians, Convention(rotation=rotation, angle_unit="deg"))
    assert "angles are in radians, not degrees" in judged(said_deg).sentences()[1]


def test_angles_written_backwards_are_named() -> None:
    poses = numbers()[:, [0, 1, 2, 5, 4, 3]]
    found = judged(ReportedPoses(poses, Convention()))
    assert found.cause == hypotheses.ANGLES
    assert "order (2, 1, 0)" in found.sentences()[1]


@pytest.mark.parametrize(
    ("meant", "said"), [("rotation_vector", "abc"), ("abc", "rotation_vector"), ("xyz", "abc")]
)
def test_another_kind_of_angles_is_named(meant: str, said: str) -> None:
    found = judged(ReportedPoses(numbers(meant), Convention(rotation=said)))
    assert found.cause == hypotheses.ANGLES


def test_inverse_poses_are_named() -> None:
    found = judged(kuka_poses(np.linalg.inv(seen()[0].base_from_flange)))
    assert found.cause == hypotheses.INVERSE


def test_two_mistakes_at_once_are_both_named() -> None:
    poses = kuka_poses(np.linalg.inv(seen()[0].base_from_flange)).numbers
    poses[:, :3] *= 1e-3
    assert judged(ReportedPoses(poses, Convention())).cause == f"{hypotheses.UNITS} and {hypotheses.INVERSE}"


@pytest.mark.parametrize("change", [4, 7, 10])
def test_a_board_that_was_moved_in_mid_run_is_named_with_the_moment(change: int) -> None:
    board = seen()[1].copy()
    board[change:] = board[change:] @ frame(np.array([3.0, -2.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    found = judged(kuka_poses(seen()[0].base_from_flange), board)
    assert found.cause == hypotheses.MOVED_BOARD
    assert f"between image {change - 1} and image {change}" in found.sentences()[1]


def test_a_board_that_moved_by_less_than_a_bad_robot_may_err_is_named_too() -> None:
    cell, board = seen()
    board = board.copy()
    board[6:] = board[6:] @ frame(np.array([1.0, 0.0, 0.0]), np.zeros(3))
    allowed = expected_scatter(board, pixel_px=0.1, focal_px=1600.0, robot_mm=0.3, robot_deg=0.02)
    names = [f"image {i}" for i in range(IMAGES)]
    found = diagnose(kuka_poses(cell.base_from_flange), board, allowed, names)
    assert found.cause == hypotheses.MOVED_BOARD
    assert "between image 5 and image 6" in found.sentences()[1]


@cache
def steady() -> tuple[Cell, Array]:
    """A cell whose arm has repeatability alone, and the board as seen."""
    cell = make_cell(3, images=24, robot_mm=0.03, robot_deg=0.003)
    return cell, calibrate_camera(cell.sightings, cell.size_px).camera_from_board


def of_steady(base_from_flange: Array, order: Array | None = None) -> Diagnosis:
    cell, board = steady()
    expected = expected_scatter(
        board, pixel_px=0.1, focal_px=cell.lens.focal_px[0], robot_mm=0.03, robot_deg=0.003
    )
    order = np.arange(len(board)) if order is None else order
    return diagnose(kuka_poses(base_from_flange[order]), board[order], expected, [f"image {i}" for i in order])


def test_a_board_that_moved_by_a_few_times_the_noise_is_named_though_the_scatter_falls_little() -> None:
    flange = steady()[0].base_from_flange
    step = frame(np.array([0.2, -0.25, 0.0]), np.zeros(3))
    moved = np.stack([step @ pose if n >= 13 else pose for n, pose in enumerate(flange)])
    found = of_steady(moved)
    assert found.scatter_mm < 3.0 * of_steady(flange).scatter_mm
    assert found.cause == hypotheses.MOVED_BOARD
    assert "between image 12 and image 13, by 0.3" in found.sentences()[1]


def test_an_arm_that_errs_smoothly_over_the_cell_is_not_called_a_moved_board() -> None:
    flange = steady()[0].base_from_flange.copy()
    along = flange[:, 0, 3] - flange[:, 0, 3].mean()
    flange[:, 1, 3] += 0.3 * along / np.abs(along).max()
    found = of_steady(flange, np.argsort(along))
    assert found.cause is None


@pytest.mark.parametrize("wrong", [0, 6, 13])
def test_a_wrong_pair_is_named(wrong: int) -> None:
    flange = seen()[0].base_from_flange.copy()
    flange[wrong] = flange[wrong] @ frame(np.array([20.0, 0.0, 5.0]), np.array([3.0, 0.0, 0.0]))
    found = judged(kuka_poses(flange))
    assert found.cause == hypotheses.WRONG_PAIR
    assert f"image {wrong} " in found.sentences()[1]


def test_two_poses_that_are_exchanged_are_named() -> None:
    flange = seen()[0].base_from_flange.copy()
    flange[[3, 9]] = flange[[9, 3]]
    found = judged(kuka_poses(flange))
    assert found.cause == hypotheses.WRONG_PAIR
    assert "the poses of image 3 and image 9 are exchanged" in found.sentences()[1]


def test_images_that_are_one_off_from_their_poses_are_named() -> None:
    cell, board = seen()
    found = judged(kuka_poses(cell.base_from_flange[:-1]), board[1:])
    assert found.cause == hypotheses.SHIFTED


def test_a_robot_that_is_merely_worse_than_stated_is_given_no_false_cause() -> None:
    cell, board = seen()
    random = np.random.default_rng(5)
    shaken = np.stack([t @ frame(random.normal(0, 2, 3), random.normal(0, 0.2, 3)) for t in cell.base_from_flange])
    found = judged(kuka_poses(shaken), board)
    assert found.contradicts
    assert found.cause is None
    assert "worse than stated" in found.sentences()[1]


def test_methods_that_disagree_beyond_their_noise_are_named() -> None:
    cell, board = seen()
    stretched = cell.base_from_flange.copy()
    stretched[:, :3, 3] *= 1.05  # a robot whose millimetres are too long
    found = judged(kuka_poses(stretched), board)
    assert any(apart.beyond_noise for apart in found.disagreements)
    assert "methods disagree by" in found.sentences()[-1]

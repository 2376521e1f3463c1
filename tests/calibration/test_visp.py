"""ViSP's hand-eye data: a real robot, a real camera, a published result.

Published (tutorial-calibration-extrinsic-eye-in-hand of the ViSP documentation): the translation of eMc, by the
data of apps/calibration/hand-eye/data-eye-in-hand and the camera below.
"""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from places import SHARED_DATA
from synthesis import Array

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.grey_image import Picture
from coupole.calibration.lens.board import Board, Sighting, detect
from coupole.calibration.lens.bundle import RobotNoise, calibrate_hand_eye
from coupole.calibration.lens.camera import board_pose, calibrate_camera, without_gross_errors
from coupole.calibration.lens.diagnosis import diagnose, expected_scatter
from coupole.calibration.lens.equations import Poses
from coupole.calibration.lens.hand_eye import METHODS, solve
from coupole.calibration.optics import Intrinsics
from coupole.calibration.poses import Convention, ReportedPoses

DATA = SHARED_DATA / "handeye"
PUBLISHED_MM = (57.71516595, -33.92489398, -42.2769157)
CAMERA = Intrinsics(607.593, 607.575, 323.463, 243.255)
BOARD = Board(kind="chessboard", corners=(9, 6), square_mm=23.6)
CONVENTION = Convention(length_unit="m", angle_unit="rad", rotation="rotation_vector")

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="ViSP's data are not on this machine")


@cache
def sightings() -> tuple[Sighting, ...]:
    import cv2

    images = [cv2.imread(str(DATA / f"{i}.png"), 0) for i in range(1, 9)]
    found = [detect(BOARD, Picture.of_grey(image, name=f"{i}.png")) for i, image in enumerate(images, start=1)]
    assert all(isinstance(seen, Sighting) for seen in found), found
    return tuple(seen for seen in found if isinstance(seen, Sighting))


def poses() -> ReportedPoses:
    texts = [(DATA / f"p{i}.yaml").read_text() for i in range(1, 9)]
    return ReportedPoses(np.array([re.findall(r"\[(.*?)\]", text) for text in texts], float), CONVENTION)


def boards(lens: Intrinsics) -> Array:
    return np.stack([board_pose(seen, lens) for seen in sightings()])


def test_park_gives_the_published_translation_within_half_a_millimetre() -> None:
    found = solve(poses().base_from_flange, boards(CAMERA))
    assert np.abs(found.flange_from_camera[:3, 3] - PUBLISHED_MM).max() < 0.1
    assert found.scatter_mm == pytest.approx(5.41, abs=0.05)  # ViSP's own mean residual


@pytest.mark.parametrize("model", ["radial", "brown5"])
def test_with_a_lens_from_the_same_images_the_interval_contains_what_is_published(model: str) -> None:
    lens = calibrate_camera(sightings(), (640, 480), model)
    found = calibrate_hand_eye(
        without_gross_errors(lens),
        Poses(poses().base_from_flange),
        lens=lens.intrinsics,
        model=model,
        robot=RobotNoise(),
    )
    at = [found.names.index(f"flange_from_camera.{axis}_mm") for axis in "xyz"]
    half = coverage_factor(found.degrees[at]) * np.sqrt(np.diag(found.covariance)[at])
    assert np.all(np.abs(found.flange_from_camera[:3, 3] - PUBLISHED_MM) < half)
    assert np.all(half < 10.0)


def test_robot_and_camera_contradict_each_other_and_no_false_cause_is_named() -> None:
    stated = RobotNoise().pose_sigmas(axes_known=False)
    expected = expected_scatter(
        boards(CAMERA), pixel_px=0.3, focal_px=607.6, robot_mm=stated[0], robot_deg=float(np.degrees(stated[1]))
    )
    found = diagnose(poses(), boards(CAMERA), expected, [f"{i}.png" for i in range(1, 9)])
    assert found.contradicts
    assert found.cause is None
    assert found.of_methods().startswith("methods differ: Park and Daniilidis by 1.4 mm")
    assert all(apart.beyond_noise for apart in found.disagreements)


def test_what_the_three_methods_differ_by_is_within_what_eight_poses_leave_open() -> None:
    flange, board = poses().base_from_flange, boards(CAMERA)
    shifts = np.stack([solve(flange, board, method).flange_from_camera[:3, 3] for method in METHODS.values()])
    assert 0.5 < np.ptp(shifts, axis=0).max() < 2.0  # Daniilidis differs by a millimetre

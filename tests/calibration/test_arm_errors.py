"""An arm whose axes have zero errors, as the simulated controller has them: hand-eye from its reported joints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from arms import KR10_R1100_SIXX
from synthesis import Array, TrueLens, board_points, frame, looking_at_board

from coupole.calibration.arm_errors import axis_sensitivity
from coupole.calibration.lens.board import Sighting
from coupole.calibration.lens.bundle import HandEyeCalibration, RobotNoise, calibrate_hand_eye
from coupole.calibration.lens.camera import calibrate_camera
from coupole.calibration.lens.equations import Poses
from coupole.calibration.rotations import between
from coupole.kinematics import forward, inverse, nearest
from sim.devices.kuka_kinematics import PoseErrors

ABSOLUTE_DEG = 0.02
HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
LENS = TrueLens((1591.0, 1592.5), (510.0, 386.0), (0.05, 0.03, 5e-4, -4e-4, 0.02))
SIZE_PX = (1024, 768)


def measured(seed: int, images: int) -> tuple[HandEyeCalibration, Array, PoseErrors]:
    """A calibration with an arm that errs as the simulated one does, and the true hand-eye."""
    random = np.random.default_rng(seed)
    errors = PoseErrors(seed, 30.0, 0.003, 0.3, ABSOLUTE_DEG)
    points = board_points()
    hand_eye = frame(np.array([5.0, -8.0, 120.0]), random.uniform(-5, 5, 3))
    base_from_board = frame(np.array([640.0, 0.0, 150.0]), random.uniform(-10, 10, 3))
    joints, sightings = [], list[Sighting]()
    while len(sightings) < images:
        board_from_camera = looking_at_board(random, points.max(axis=0)[:2], 335.0)
        ways = inverse(KR10_R1100_SIXX, base_from_board @ board_from_camera @ np.linalg.inv(hand_eye))
        if not len(ways):
            continue
        at = nearest(KR10_R1100_SIXX, ways, HOME_DEG)
        true = errors.true_flange_pose(at.tolist(), len(sightings)) @ hand_eye
        seen = LENS.see((base_from_board @ np.c_[points, np.ones(len(points))].T).T[:, :3] @ true[:3, :3]
                        - true[:3, 3] @ true[:3, :3])  # fmt: skip
        ids = np.flatnonzero(np.all((seen > 4) & (seen < (SIZE_PX[0] - 4, SIZE_PX[1] - 4)), axis=1))
        if len(ids) > 25:
            joints.append(at)
            noisy = seen[ids] + random.normal(0, 0.1, (len(ids), 2))
            sightings.append(Sighting(f"image {len(sightings)}", ids, points[ids], noisy))
    lens = calibrate_camera(sightings, SIZE_PX)
    poses = Poses(
        np.stack([forward(KR10_R1100_SIXX, at) for at in joints]), axis_sensitivity(KR10_R1100_SIXX, joints)
    )
    robot = RobotNoise(0.03, 0.003, 0.3, ABSOLUTE_DEG)
    return calibrate_hand_eye(sightings, poses, lens=lens.intrinsics, robot=robot), hand_eye, errors


def test_intervals_hold_though_the_axes_have_zero_errors(scale: Callable[[int, int], int]) -> None:
    cells = scale(3, 100)
    ratios, off_mm = [], []
    for seed in range(cells):
        found, hand_eye, errors = measured(seed, scale(15, 40))
        step = -between(found.flange_from_camera, hand_eye) * [1, 1, 1, *np.degrees([1, 1, 1])]
        zeros = found.axis_zeros_deg - errors.axis_zero_error_deg()
        u = np.sqrt(np.diag(found.covariance))
        first = found.names.index("flange_from_camera.x_mm")
        ratios.append(np.concatenate([step / u[first : first + 6], zeros / u[-6:]]))
        off_mm.append(np.linalg.norm(step[:3]))
    assert np.abs(ratios).max() < 4.5
    assert np.median(off_mm) < 0.15
    if cells >= 100:
        covered, spread = np.mean(np.abs(ratios) < 1.96), np.sqrt(np.mean(np.square(ratios)))
        assert 0.90 <= covered <= 0.99
        assert 0.8 < spread < 1.25
        assert np.median(off_mm) < 0.06

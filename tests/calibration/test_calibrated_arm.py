"""A mesh found from an arm whose axes have zero errors, as a hand-eye calibration knows them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens, frame, looking_at_board
from test_point_sets import layout

from coupole.calibration.calibrated_arm import CalibratedArm, calibrated_poses
from coupole.calibration.light.frames import LightFrame, LightFrames
from coupole.calibration.multi_view import CameraView
from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.rotations import moved_transforms
from coupole.calibration.sources import About
from coupole.calibration.stickers.mesh_to_robot import Stated, mesh_to_robot
from coupole.errors import InputError
from coupole.kinematics import forward, inverse, nearest
from coupole.plan.shot_id import ShotId

LENS = TrueLens((1740.0, 1740.0), (511.5, 383.5), (0.0, 0.0, 0.0, 0.0, 0.0))
SIZE_PX = (1024, 768)
HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
ZEROS_DEG = np.array([0.0, -0.02, 0.017, -0.02, 0.012, 0.03])
STATED = Stated(sticker_px=0.05, scanner_mm=0.03, robot_mm=0.03, robot_deg=0.003)
LENS_FREE = ("fx", "fy", "cx", "cy")
U = np.array([0.05] * 4 + [0.02] * 3 + [np.radians(0.003)] * 3 + [0.001, 0.001, 0.001, 0.0015, 0.004])
"""Of the lens, the hand-eye's step, and the zeros of A2 to A6."""


@dataclass(frozen=True)
class Seen:
    """What a run and records would say, and the truth."""

    joints_deg: Array
    pixels: list[Array]
    prior: CameraPrior
    arm: CalibratedArm
    table_mm: Array
    base_from_mesh: Array


def seen(seed: int, views: int = 12, stickers: int = 20) -> Seen:
    random = np.random.default_rng(seed)
    places = 0.4 * layout(random, stickers)
    base_from_mesh = frame(np.array([640.0, 0.0, 150.0]), random.uniform(-10, 10, 3))
    hand_eye = frame(np.array([5.0, -8.0, 120.0]), random.uniform(-5, 5, 3))
    joints: list[Array] = []
    pixels: list[Array] = []
    while len(joints) < views:
        mesh_from_camera = looking_at_board(random, np.zeros(2), 400.0)
        ways = inverse(KR10_R1100_SIXX, base_from_mesh @ mesh_from_camera @ np.linalg.inv(hand_eye))
        if not len(ways):
            continue
        at = nearest(KR10_R1100_SIXX, ways, HOME_DEG)
        own = np.concatenate([random.normal(0, 0.03, 3), np.radians(random.normal(0, 0.003, 3))])
        camera = moved_transforms(forward(KR10_R1100_SIXX, at + ZEROS_DEG), own) @ hand_eye
        in_base = places @ base_from_mesh[:3, :3].T + base_from_mesh[:3, 3]
        spots = LENS.see((in_base - camera[:3, 3]) @ camera[:3, :3])
        inside = np.all((spots > 4) & (spots < (SIZE_PX[0] - 4, SIZE_PX[1] - 4)), axis=1)
        joints.append(at)
        pixels.append(spots[inside] + random.normal(0, 0.05, (int(inside.sum()), 2)))
    off = U * random.normal(size=len(U))
    arm = CalibratedArm(KR10_R1100_SIXX, ZEROS_DEG + np.array([0.0, *off[10:]]), np.diag(U**2))
    lens = Intrinsics(1740.0 + off[0], 1740.0 + off[1], 511.5 + off[2], 383.5 + off[3])
    known = places + random.normal(0, 0.03, places.shape)
    return Seen(
        np.array(joints),
        pixels,
        CameraPrior(lens, LENS_FREE, moved_transforms(hand_eye, off[4:10]), np.diag(U[:10] ** 2)),
        arm,
        known,
        base_from_mesh,
    )


def reported(joints_deg: Array) -> Array:
    return np.stack([forward(KR10_R1100_SIXX, at) for at in joints_deg])


def poses(made: Seen) -> tuple[Array, CameraPrior]:
    return calibrated_poses(reported(made.joints_deg), made.joints_deg, made.arm, made.prior)


def test_poses_are_those_of_the_axes_with_their_zero_errors() -> None:
    made = seen(1)
    found, _ = poses(made)
    true = np.stack([forward(KR10_R1100_SIXX, at + made.arm.zeros_deg) for at in made.joints_deg])
    assert np.abs(found[:, :3, 3] - true[:, :3, 3]).max() < 1e-3
    assert np.abs(found[:, :3, :3] - true[:, :3, :3]).max() < 1e-6
    assert np.linalg.norm(found[:, :3, 3] - reported(made.joints_deg)[:, :3, 3], axis=1).min() > 0.1


def test_frames_of_light_are_posed_by_the_axes_with_their_zero_errors() -> None:
    made = seen(1)
    flanges = reported(made.joints_deg)
    frames = tuple(
        LightFrame(
            ShotId.parse(f"v{row // 2}/led0005/e{row % 2}"),
            1e4,
            0.0,
            math.nan,
            flanges[row // 2],
            np.eye(4),
            blank,
        )
        for row in range(2 * len(flanges))
    )
    frames = tuple(replace(one, joints_deg=made.joints_deg[row // 2]) for row, one in enumerate(frames))
    light = LightFrames(frames, "GBRG", 64, 4095, About(is_simulated=True), 1740.0, ())
    posed = light.seen_through(made.prior.flange_from_camera, made.arm)
    for row, one in enumerate(posed.frames):
        true = forward(KR10_R1100_SIXX, made.joints_deg[row // 2] + made.arm.zeros_deg)
        assert np.abs(one.base_from_flange - true).max() < 1e-3
        assert np.abs(one.base_from_camera - true @ made.prior.flange_from_camera).max() < 1e-3
    with pytest.raises(InputError, match="without the arm's joints"):
        replace(light, frames=(replace(frames[0], joints_deg=None),)).seen_through(np.eye(4), made.arm)


def blank() -> NDArray[np.uint16]:
    return np.zeros((2, 2), np.uint16)


@pytest.mark.full
def test_intervals_hold_with_what_is_left_of_the_zero_errors(scale: Callable[[int, int], int]) -> None:
    scenes = scale(6, 100)
    normalised, off_mm = [], []
    for seed in range(scenes):
        made = seen(seed)
        base_from_flange, known = poses(made)
        views = [
            CameraView(f"v{number}", pose @ made.prior.flange_from_camera, spots)
            for number, (pose, spots) in enumerate(zip(base_from_flange, made.pixels, strict=True))
        ]
        names = [f"T{row}" for row in range(len(made.table_mm))]
        found = mesh_to_robot(views, made.prior.lens, made.table_mm, names, stated_noise=STATED, prior=known)
        turn = Rotation.from_matrix(found.base_from_mesh[:3, :3].T @ made.base_from_mesh[:3, :3])
        shift = made.base_from_mesh[:3, 3] - found.base_from_mesh[:3, 3]
        step = np.concatenate([shift, turn.as_rotvec(degrees=True)])
        normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance), step))
        off_mm.append(np.linalg.norm(shift))
    z = np.concatenate(normalised)
    slack = 0.0 if scenes >= 100 else 0.3
    assert 0.90 - slack / 2 <= np.mean(np.abs(z) < 1.98) <= 0.99 + slack
    assert 0.8 - slack < np.sqrt(np.mean(z**2)) < 1.25 + slack
    assert np.median(off_mm) < 0.06

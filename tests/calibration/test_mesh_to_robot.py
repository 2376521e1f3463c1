"""A mesh found by its stickers: in the right place, with an interval that holds, some of them missing or false."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens, frame
from test_point_sets import layout

from coupole.calibration.multi_view import CameraView, unproject
from coupole.calibration.optics import Intrinsics
from coupole.calibration.stickers.mesh_to_robot import MeshPose, Stated, mesh_to_robot
from coupole.errors import InputError

LENS = TrueLens((6960.0, 6960.0), (2047.5, 1535.5), (-0.05, 0.02, 2e-4, -3e-4, 0.0))
INTRINSICS = Intrinsics(6960.0, 6960.0, 2047.5, 1535.5, -0.05, 0.02, 2e-4, -3e-4, 0.0)
WIDTH_PX, HEIGHT_PX = 4096, 3072


@dataclass(frozen=True)
class Scene:
    views: list[CameraView]
    targets_mm: Array
    names: list[str]
    base_from_mesh: Array


def camera_at(target_mm: Array, distance_mm: float, azimuth_deg: float, elevation_deg: float) -> Array:
    a, e = np.radians([azimuth_deg, elevation_deg])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    z = -towards
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = target_mm + distance_mm * towards
    return pose


def scene(
    seed: int,
    *,
    stickers: int = 24,
    lost: float = 0.0,
    false: int = 0,
    pixel_px: float = 0.1,
    scanner_mm: float = 0.03,
    robot_mm: float = 0.03,
    robot_deg: float = 0.003,
) -> Scene:
    """A bumpy dome of stickers before ten cameras. A share `lost` of those in the table is gone, more are hidden;
    each picture holds `false` spots."""
    random = np.random.default_rng(seed)
    places = 0.5 * layout(random, stickers)
    turn_deg = Rotation.random(random_state=seed).as_rotvec(degrees=True)
    base_from_mesh = frame(np.array((200.0, 0.0, 1450.0)) + random.uniform(-50, 50, 3), turn_deg)
    in_base = places @ base_from_mesh[:3, :3].T + base_from_mesh[:3, 3]
    up = base_from_mesh[:3, 2]
    visible_to = np.setdiff1d(np.arange(stickers), random.permutation(stickers)[: int(lost * stickers)])
    views = []
    for number in range(10):
        around = (
            base_from_mesh[:3, :3] @ camera_at(np.zeros(3), 1.0, 36.0 * number, 35 + 40 * (number % 2))[:3, :3]
        )
        true = np.eye(4)
        true[:3, :3] = around
        true[:3, 3] = in_base.mean(axis=0) + random.normal(0, 4, 3) - 380 * around[:, 2]
        pixels = []
        for point in in_base[visible_to]:
            u, v = LENS.see(true[:3, :3].T @ (point - true[:3, 3]))
            seen = 0 < u < WIDTH_PX and 0 < v < HEIGHT_PX and random.random() > lost / 2
            if seen and (true[:3, 3] - point) @ up > 0:
                pixels.append((u + random.normal(0, pixel_px), v + random.normal(0, pixel_px)))
        pixels += [tuple(random.uniform((0, 0), (WIDTH_PX, HEIGHT_PX))) for _ in range(false)]
        off = frame(random.normal(0, robot_mm, 3), random.normal(0, robot_deg, 3))
        reported = true.copy()
        reported[:3, 3] += off[:3, 3]
        reported[:3, :3] = true[:3, :3] @ off[:3, :3]
        views.append(CameraView(f"view{number}", reported, np.array(random.permutation(pixels)).reshape(-1, 2)))
    known = places + random.normal(0, scanner_mm, places.shape)
    order = random.permutation(stickers)
    return Scene(views, known[order], [f"T{row}" for row in order], base_from_mesh)


def found(made: Scene, **stated: float) -> MeshPose:
    noise = {"robot_mm": 0.03, "robot_deg": 0.003, **stated}
    return mesh_to_robot(made.views, INTRINSICS, made.targets_mm, made.names, stated_noise=Stated(**noise))


def off(pose: MeshPose, made: Scene) -> Array:
    """Step [6] from the estimate to the truth: mm, deg."""
    turn = pose.base_from_mesh[:3, :3].T @ made.base_from_mesh[:3, :3]
    shift = made.base_from_mesh[:3, 3] - pose.base_from_mesh[:3, 3]
    return np.concatenate([shift, Rotation.from_matrix(turn).as_rotvec(degrees=True)])


def test_rays_are_those_that_project_to_the_pixels() -> None:
    pixels = np.random.default_rng(1).uniform((0, 0), (WIDTH_PX, HEIGHT_PX), (50, 2))
    rays = unproject(pixels, INTRINSICS)
    assert np.abs(np.array([LENS.see(ray) for ray in rays]) - pixels).max() < 1e-6


def test_without_noise_the_mesh_is_found_exactly() -> None:
    made = scene(1, pixel_px=0.0, scanner_mm=0.0, robot_mm=0.0, robot_deg=0.0)
    pose = found(made)
    assert np.abs(off(pose, made)).max() < 1e-5
    assert set(pose.recognised_names) == set(made.names)


def test_the_centre_of_a_mesh_is_found_to_well_below_sixty_micrometres() -> None:
    errors = []
    for seed in range(6):
        made = scene(seed)
        pose = found(made)
        centre = made.targets_mm.mean(axis=0)
        errors.append(
            np.linalg.norm(
                (pose.base_from_mesh[:3, :3] - made.base_from_mesh[:3, :3]) @ centre
                + pose.base_from_mesh[:3, 3]
                - made.base_from_mesh[:3, 3]
            )
        )
    assert np.median(errors) < 0.06


@pytest.mark.parametrize("seed", range(4))
def test_a_third_of_the_stickers_missing_and_as_many_false_change_no_match(seed: int) -> None:
    made = scene(seed, stickers=30, lost=0.33, false=8)
    pose = found(made)
    assert np.abs(off(pose, made)[:3]).max() < 0.3
    assert len(pose.recognised_names) >= 14
    assert len(pose.missing) >= 9


@pytest.mark.full
def test_intervals_hold(scale: Callable[[int, int], int]) -> None:
    normalised = []
    for seed in range(scale(12, 100)):
        made = scene(100 + seed)
        pose = found(made)
        normalised.append(np.linalg.solve(np.linalg.cholesky(pose.covariance), off(pose, made)))
    z = np.concatenate(normalised)
    within = np.mean(np.abs(z) < 1.96)
    slack = 3 * np.sqrt(0.05 * 0.95 / len(z))
    assert 0.95 - slack - 0.03 <= within <= 1.0
    assert 0.8 - 2 / np.sqrt(len(z)) < np.sqrt(np.mean(z**2)) < 1.25 + 2 / np.sqrt(len(z))


def test_targets_in_metres_are_not_found() -> None:
    made = scene(2)
    with pytest.raises(InputError, match="no motion brings"):
        mesh_to_robot(made.views, INTRINSICS, made.targets_mm / 1000, made.names)


def test_an_object_that_is_not_in_the_pictures_is_not_found() -> None:
    made, other = scene(3), scene(4)
    with pytest.raises(InputError, match="no motion brings"):
        mesh_to_robot(made.views, INTRINSICS, other.targets_mm, other.names)

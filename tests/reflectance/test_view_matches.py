"""How far apart views put the same spot, and the unknowns that explain it: against closed forms and OpenCV."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.errors import InputError
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.alignment import refinement
from coupole.reflectance.alignment.refinement import match_lines, refine
from coupole.reflectance.alignment.unknowns import Given, Unknowns, control_points
from coupole.reflectance.alignment.view_matches import Matches, match_views
from coupole.reflectance.alignment.view_surface import ViewSurface, view_surface
from coupole.reflectance.extraction.pointing import Doubts, camera_covariance

Floats = NDArray[np.float64]
LENS = Intrinsics(800.0, 800.0, 199.5, 149.5, k1=-0.05)
SIZE = (200, 150)
"""Blocks across and down."""
FLOOR = np.array([[[-60, -60, 0], [60, -60, 0], [60, 60, 0]], [[-60, -60, 0], [60, 60, 0], [-60, 60, 0]]], float)
UP = np.array([[0, 0, 1.0], [0, 0, 1.0]])


def camera(*, azimuth_deg: float, tilt_deg: float) -> Floats:
    """[4, 4] base_from_camera, 300 mm from the origin, looking at it."""
    turn = Rotation.from_euler("ZYX", [azimuth_deg, tilt_deg, 180], degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -300 * turn[:, 2]
    return pose


CAMERAS = (camera(azimuth_deg=0, tilt_deg=10), camera(azimuth_deg=70, tilt_deg=30))


def painted(pose: Floats, shift_mm: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float32]:
    """What a camera shows of waves painted on z = 0, and shifted: rays by OpenCV."""
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = np.stack([2 * columns + 0.5, 2 * rows + 0.5], axis=-1).reshape(-1, 1, 2).astype(float)
    straight = cv2.undistortPointsIter(
        pixels, LENS.matrix(), LENS.distortion(), None, None, (cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    )
    ways = np.concatenate([straight[:, 0], np.ones((len(straight), 1))], axis=1) @ pose[:3, :3].T
    place = (pose[:3, 3] - pose[2, 3] / ways[:, 2:] * ways)[:, :2] - shift_mm
    random = np.random.default_rng(1)
    waves = random.standard_normal((40, 2)) * 1.2
    values = np.cos(place @ waves.T + random.uniform(0, 6, 40)).sum(axis=1)
    return (10 + values).reshape(SIZE[::-1]).astype(np.float32)


def surface(pose: Floats, picture: NDArray[np.float32]) -> ViewSurface:
    return view_surface(picture, PacketMesh(FLOOR), UP, LENS, pose, threads=1)


def matched(pictures: list[NDArray[np.float32]]) -> Matches:
    views = [surface(pose, picture) for pose, picture in zip(CAMERAS, pictures, strict=True)]
    return match_views(views, 3.0, 1, lambda step, done, of: None)


def test_places_of_blocks_are_where_rays_meet_the_mesh() -> None:
    view = surface(CAMERAS[1], painted(CAMERAS[1]))
    used = np.isfinite(view.points_mm[..., 0])
    rows, columns = (places[::97] for places in np.nonzero(used))
    points = view.points_mm[rows, columns].astype(float)
    turn, place = CAMERAS[1][:3, :3], CAMERAS[1][:3, 3]
    pixels, _ = cv2.projectPoints(
        points, cv2.Rodrigues(turn.T)[0], -turn.T @ place, LENS.matrix(), LENS.distortion()
    )
    np.testing.assert_allclose(pixels[:, 0], np.stack([2 * columns + 0.5, 2 * rows + 0.5], axis=1), atol=0.05)
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-3)


def test_a_shift_of_what_one_view_shows_is_found_on_the_surface() -> None:
    found = matched([painted(CAMERAS[0]), painted(CAMERAS[1], (1.3, -0.8))])
    assert len(found.blocks) > 80
    sign = np.where(found.other == 1, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(np.median(sign * found.shifts_mm, axis=0), [1.3, -0.8, 0.0], atol=0.02)
    assert (
        np.quantile(np.linalg.norm(sign * found.shifts_mm - [1.3, -0.8, 0.0], axis=1), 0.95) < 0.05
    )  # a block is 0.4 mm wide


def test_stated_covariances_of_shifts_hold_what_noise_does() -> None:
    random = np.random.default_rng(2)
    pictures = [(painted(pose) + 0.6 * random.standard_normal(SIZE[::-1])).astype(np.float32) for pose in CAMERAS]
    found = matched(pictures)
    off = found.matched_blocks - found.expected_blocks
    square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance), off)
    assert len(off) > 80
    assert 0.8 < np.mean(square < 5.99) <= 1.0
    assert 0.5 < np.median(square) / 1.386 < 2.0  # chi square of two


def test_a_place_that_another_surface_hides_is_not_matched() -> None:
    wall = np.array([[[5, -60, 0], [5, 60, 0], [5, 60, 60]], [[5, -60, 0], [5, 60, 60], [5, -60, 60]]], float)
    normals = np.concatenate([UP, [[-1.0, 0, 0], [-1.0, 0, 0]]])
    mesh = PacketMesh(np.concatenate([FLOOR, wall]))
    beyond = view_surface(
        painted(CAMERAS[0]), mesh, normals, LENS, camera(azimuth_deg=180, tilt_deg=40), threads=1
    )
    hidden, shown = np.array([[20.0, 0, 0]]), np.array([[-20.0, 0, 0]])
    before = [beyond.detail(place, UP[:1])[0] for place in (hidden, shown)]
    assert sorted(value > 0 for value in before) == [False, True]


def unknowns() -> Unknowns:
    x, y = np.meshgrid(np.linspace(-60, 60, 13), np.linspace(-60, 60, 13))
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = np.arange(169).reshape(13, 13)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.uint32)
    free = ("fx", "cy", "k1")
    given = Given(LENS, free, np.stack(CAMERAS), np.eye(15) * 1e-2, vertices, triangles)
    doubts = Doubts(shape_mm=0.2, scale_mm=40.0)
    return Unknowns(given, doubts, control_points(vertices, 40.0))


@pytest.mark.parametrize("part", ["lens", "first camera", "second camera", "mesh", "shape"])
def test_derivatives_are_what_steps_do(part: str) -> None:
    """A spot's block in the second view after a step: the ray of the first to the moved surface, with OpenCV."""
    known = unknowns()
    where = {
        "lens": known.lens, "first camera": known.camera(0), "second camera": known.camera(1), "mesh": known.mesh,
        "shape": known.shape,
    }[part]  # fmt: skip
    step = np.zeros(known.count)
    size = {"lens": [0.5, 0.5, 0.002], "shape": np.linspace(0.05, 0.1, where.stop - where.start)}
    step[where] = size.get(part, np.array([0.05, -0.03, 0.04, 2e-4, -1e-4, 3e-4]))
    still = np.array([[3.0, -8.0, 0.0], [-15.0, 4.0, 0.0]])
    blocks = np.array([block_of(known, np.zeros(known.count), 0, point) for point in still])
    matches = Matches(
        *np.zeros((2, 2), np.int64), blocks, still, UP, blocks, blocks, np.stack([np.eye(2)] * 2), still
    )
    matches = replace(matches, other=np.ones(2, np.int64))
    [line] = match_lines(known, np.zeros(known.count), matches)
    predicted = (line.jacobian @ step[line.columns]).reshape(-1, 2)
    for number, block in enumerate(blocks):
        after = block_of(known, step, 1, met(known, step, block))
        before = block_of(known, np.zeros(known.count), 1, still[number])
        np.testing.assert_allclose(predicted[number], after - before, atol=0.04 * np.abs(after - before).max())


def block_of(known: Unknowns, step: Floats, view: int, point: Floats) -> Floats:
    lens, pose = known.lens_at(step), known.cameras_at(step)[view]
    turn = pose[:3, :3].T
    pixel, _ = cv2.projectPoints(
        point[None], cv2.Rodrigues(turn)[0], -turn @ pose[:3, 3], lens.matrix(), lens.distortion()
    )
    return np.asarray((pixel[0, 0] - 0.5) / 2)


def met(known: Unknowns, step: Floats, block: Floats) -> Floats:
    """Where the first view's ray of a block meets the moved mesh."""
    lens, pose = known.lens_at(step), known.cameras_at(step)[0]
    end = (cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    pixel = (2 * block + 0.5).reshape(1, 1, 2)
    straight = cv2.undistortPointsIter(pixel, lens.matrix(), lens.distortion(), None, None, end)[0, 0]
    way = pose[:3, :3] @ [*straight, 1.0]
    corners = known.vertices_at(step)[known.prior_geometry.triangles]
    for a, b, c in corners:
        far, u, v = np.linalg.solve(np.stack([-way, b - a, c - a], axis=1), pose[:3, 3] - a)
        if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
            return np.asarray(pose[:3, 3] + far * way)
    raise AssertionError("no triangle met")


def test_the_covariance_of_poses_is_that_of_drawn_hand_eyes_and_arms() -> None:
    random = np.random.default_rng(4)
    u_mm, u_rad, arm = 0.5, 2e-3, Doubts(arm_mm=0.2, arm_deg=0.05)
    hand_eye = np.eye(4)
    hand_eye[:3, :3], hand_eye[:3, 3] = Rotation.from_euler("x", 40, degrees=True).as_matrix(), [10, 20, 120]
    cameras = np.stack(CAMERAS)
    flanges = cameras @ np.linalg.inv(hand_eye)
    by_zeros, u_deg = random.standard_normal((2, 6, 2)) * np.repeat([6.0, 0.02], 3)[:, None], 0.1
    own = np.diag([u_mm**2] * 3 + [u_rad**2] * 3 + [u_deg**2] * 2)
    prior = CameraPrior(LENS, (), hand_eye, own, axis_sensitivity=by_zeros)
    stated = camera_covariance(prior, cameras, arm)
    drawn = []
    for _ in range(1500):
        moved_eye = stepped(hand_eye, random.standard_normal(6) * np.repeat([u_mm, u_rad], 3))
        scatter = random.standard_normal((2, 6)) * np.repeat([0.2, np.radians(0.05)], 3)
        zeros = by_zeros @ (u_deg * random.standard_normal(2))
        there = [
            stepped(flange @ stepped(np.eye(4), zero), step) @ moved_eye
            for flange, zero, step in zip(flanges, zeros, scatter, strict=True)
        ]
        drawn.append(np.concatenate([difference(is_, at) for is_, at in zip(cameras, there, strict=True)]))
    seen = np.cov(np.array(drawn).T)
    scale = np.sqrt(np.diag(stated))
    np.testing.assert_allclose(seen / np.outer(scale, scale), stated / np.outer(scale, scale), atol=0.12)


def stepped(pose: Floats, step: Floats) -> Floats:
    moved = pose.copy()
    moved[:3, 3] += step[:3]
    moved[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(step[3:]).as_matrix()
    return moved


def difference(pose: Floats, other: Floats) -> Floats:
    turn = Rotation.from_matrix(pose[:3, :3].T @ other[:3, :3]).as_rotvec()
    return np.concatenate([other[:3, 3] - pose[:3, 3], turn])


def test_views_without_anything_in_common_are_refused() -> None:
    known = unknowns()
    plain = [np.ones(SIZE[::-1], np.float32) for _ in CAMERAS]
    with pytest.raises(InputError, match="expected 30 matches or more, found 0"):
        refine(known.prior_geometry, plain, known.doubts, 1.0, 1, lambda step, done, of: None)


def test_what_is_clipped_is_not_compared() -> None:
    first, second = painted(CAMERAS[0]), painted(CAMERAS[1], (1.3, -0.8))
    first[:, 140:], second[:30] = np.nan, np.nan
    assert np.isnan(surface(CAMERAS[0], first).points_mm[:, 140:]).all()
    found = matched([first, second])
    assert len(found.blocks) > 20
    sign = np.where(found.other == 1, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(np.median(sign * found.shifts_mm, axis=0), [1.3, -0.8, 0.0], atol=0.03)


def test_a_search_is_not_wider_than_it_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    known, searched = unknowns(), []

    def matching(views: list[ViewSurface], search_mm: float, threads: int, say: refinement.Said) -> Matches:
        searched.append(search_mm)
        return match_views(views, search_mm, threads, say)

    monkeypatch.setattr(refinement, "match_views", matching)
    pictures = [painted(pose) for pose in CAMERAS]
    for search_mm, after in ((0.1, 0.1), (0.6, 0.3)):
        searched.clear()
        refine(known.prior_geometry, pictures, known.doubts, search_mm, 1, lambda step, done, of: None)
        assert searched[:2] == [search_mm, after]


def test_control_points_are_a_scale_apart_and_an_object_too_large_for_them_is_refused() -> None:
    x, y = np.meshgrid(np.arange(0.0, 1000.0, 10.0), np.arange(0.0, 1000.0, 10.0))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    chosen = control_points(points, 60.0)
    between = np.linalg.norm(chosen[:, None] - chosen, axis=2) + 1e9 * np.eye(len(chosen))
    nearest = np.linalg.norm(points[:, None] - chosen, axis=2).min(axis=1)
    assert between.min() >= 60.0 >= nearest.max()
    with pytest.raises(InputError, match=r"--scale-mm: expected [345]. or more"):
        control_points(points, 20.0)

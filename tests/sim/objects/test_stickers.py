"""Stickers lie on the surface, flat, apart, and where the truth says."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.errors import InputError
from sim.objects import shapes, standards, surfaces
from sim.objects.charuco import Charuco, charuco_board
from sim.scene.surface import Surface

STONE = shapes.sculpted_relief(150.0, triangles=8_000)


def centres_mm(surface: Surface, of: Surface, count: int) -> np.ndarray:
    """Middles of the bright disks that were added to `of`."""
    added = surface.corners_mm[len(of.corners_mm) :].reshape(count, -1, 3, 3)
    bright = added[:, : added.shape[1] // 3]
    return np.asarray(bright[:, :, 1].mean(axis=1))


def test_a_sticker_has_the_diameters_asked_for() -> None:
    one = standards.sticker(6.0, border_mm=10.0)
    radius_mm = np.linalg.norm(one.corners_mm, axis=2)
    assert radius_mm[one.material == 0].max() == pytest.approx(3.0)
    assert radius_mm[one.material == 1].min() == pytest.approx(3.0)
    assert radius_mm.max() == pytest.approx(5.0)


def test_stickers_are_where_the_truth_says() -> None:
    poses = standards.sticker_poses(STONE, 8, seed=3)
    surface = standards.stuck_on(STONE, poses)
    assert np.allclose(centres_mm(surface, STONE, 8), poses[:, :3, 3], atol=1e-9)


def test_poses_are_rigid_and_face_away_from_the_surface() -> None:
    poses = standards.sticker_poses(STONE, 8, seed=3)
    rotations = poses[:, :3, :3]
    assert np.allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotations), 1.0)
    assert np.all(rotations[:, 2, 2] > -0.2)


def test_a_sticker_rests_on_the_surface_and_does_not_sink_into_it() -> None:
    for pose in standards.sticker_poses(STONE, 8, seed=3):
        local = (STONE.corners_mm.reshape(-1, 3) - pose[:3, 3]) @ pose[:3, :3]
        under = (np.hypot(local[:, 0], local[:, 1]) < 5.0) & (np.abs(local[:, 2]) < 3.0)
        assert under.any()
        assert local[under, 2].max() < 0.0
        assert local[under, 2].min() > -1.5


def test_stickers_keep_apart_and_off_the_edges_of_a_tile() -> None:
    tile = standards.spectralon_tile(80.0)
    poses = standards.sticker_poses(tile, 8, seed=1)
    centres = poses[:, :3, 3]
    apart = np.linalg.norm(centres[:, None] - centres, axis=2) + 1e3 * np.eye(8)
    on_top = poses[:, 2, 2] > 0.9
    assert apart.min() >= 15.0 - 0.5
    assert on_top.any()
    assert np.abs(centres[on_top][:, :2]).max() < 40.0 - 3.0


def test_another_seed_puts_them_elsewhere_and_the_same_one_does_not() -> None:
    first, again, other = (standards.sticker_poses(STONE, 5, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_stickers_go_where_they_may() -> None:
    board = Charuco(margin_mm=20.0)
    surface = charuco_board(board)
    middle = np.abs(surface.corners_mm.mean(axis=1))
    half = 0.5 * board.square_mm * np.array([board.squares_x, board.squares_y])
    margin = (middle[:, :2] > half).any(axis=1)
    poses = standards.sticker_poses(surface, 8, where=margin)
    assert np.all((np.abs(poses[:, :2, 3]) > half).any(axis=1))
    assert np.allclose(poses[:, 2, 3], board.thickness_mm + 0.05)


def test_a_surface_without_room_for_them_is_refused() -> None:
    with pytest.raises(InputError, match="expected room for 50"):
        standards.sticker_poses(standards.spectralon_tile(30.0), 50)


def test_no_stickers_leave_the_surface_as_it_is() -> None:
    same = standards.stuck_on(STONE, standards.sticker_poses(STONE, 0))
    assert np.array_equal(same.corners_mm, STONE.corners_mm)
    assert surfaces.tint_of(same).shape == (len(STONE.corners_mm), 3)

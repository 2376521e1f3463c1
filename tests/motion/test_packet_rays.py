"""Rays by packets, held against embreex's own functions, which trace one ray after the other."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.motion.occlusion import blocked_along, blocked_segments, ray_mesh
from coupole.motion.packet_rays import LANES, PacketMesh


def soup(count: int) -> np.ndarray:
    """[count, 3, 3] triangles, any way round, in a ball of 100 mm."""
    random = np.random.default_rng(4)
    return random.normal(0, 40, (count, 1, 3)) + random.normal(0, 6, (count, 3, 3))


@pytest.mark.parametrize("rays", [0, 1, LANES, 1000])
def test_what_lies_between_two_points_is_found(rays: int) -> None:
    corners, random = soup(400), np.random.default_rng(rays)
    starts = random.normal(0, 60, (rays + 50, 3)).astype(np.float32)
    asked, end = random.permutation(rays + 50)[:rays], np.array([300.0, 20.0, -10.0])
    found = PacketMesh(corners).blocked_rays(starts, asked, end)
    alone = blocked_segments(ray_mesh(corners), starts[asked], np.broadcast_to(end, (rays, 3)))
    assert np.array_equal(found, alone)
    if rays == 1000:
        assert 100 < found.sum() < 900


@pytest.mark.parametrize("compact", [True, False])
def test_what_lies_on_a_way_is_found(compact: bool) -> None:
    corners, random = soup(400), np.random.default_rng(5)
    mesh, alone = PacketMesh(corners, compact), ray_mesh(corners)
    starts, ways = (random.normal(0, 60, (1003, 3)).astype(np.float32) for _ in range(2))
    for given in (ways, ways[:1]):
        found = mesh.blocked_along(starts, given)
        assert np.array_equal(found, blocked_along(alone, starts, np.broadcast_to(given, ways.shape)))
        assert 50 < found.sum() < 950


def test_the_first_triangle_on_a_ray_is_found_and_how_far_it_is() -> None:
    corners, eye = soup(400), np.array([0.0, 0.0, 400.0])
    ways = (np.random.default_rng(2).normal(0, 60, (999, 3)) - eye).astype(np.float32)
    number, distance = PacketMesh(corners).first_met(eye, ways)
    starts = np.broadcast_to(eye.astype(np.float32), ways.shape).copy()
    alone = ray_mesh(corners).run(starts, ways, query="INTERSECT", output=1)
    assert np.array_equal(number, np.asarray(alone["primID"]))
    met = number >= 0
    assert 100 < met.sum() < 900
    # Embree rounds packets and single rays alike on some processors only: 3 units in the last place were seen.
    np.testing.assert_array_max_ulp(distance[met], np.asarray(alone["tfar"], np.float32)[met], maxulp=8)
    assert np.isnan(distance[~met]).all()

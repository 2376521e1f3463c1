"""Meshes, cameras and an independent ray tracer for the tests of the renderer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.render.lens import Lens, distorted_points
from sim.scene.scene import Scene, build_scene
from sim.scene.surface import Material, Surface

GREY = Material("grey", (0.5, 0.5, 0.5))
BENT = (-0.12, 0.05, 8e-4, -5e-4, 0.02)


def scene_of(corners_mm: NDArray[np.float64], material: Material = GREY) -> Scene:
    return build_scene([(Surface(corners_mm, (material,), np.zeros(len(corners_mm), np.int32)), np.eye(4))])


def quad(centre_mm: tuple[float, float, float], half_mm: float) -> NDArray[np.float64]:
    """A horizontal square of two triangles [2, 3, 3], seen from above."""
    a, b, c, d = (
        np.array(centre_mm) + half_mm * np.array([x, y, 0]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    )
    return np.array([[a, b, c], [a, c, d]])


def sphere(radius_mm: float, subdivisions: int) -> NDArray[np.float64]:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_mm)
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


def relief(side_mm: float, cells: int, height_mm: float, seed: int = 5) -> NDArray[np.float64]:
    """A rough square, z up: [2 cells^2, 3, 3]."""
    random = np.random.default_rng(seed)
    grid = np.linspace(-side_mm / 2, side_mm / 2, cells + 1)
    x, y = np.meshgrid(grid, grid)
    z = height_mm * (np.sin(x / 7.0) * np.cos(y / 9.0) + 0.1 * random.standard_normal(x.shape))
    p = np.stack([x, y, z], axis=-1)
    a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]
    return np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)


def camera_above(distance_mm: float, tilt_deg: float = 0.0) -> Transform:
    """Camera looking at the origin from `distance_mm`, tilted away from the vertical about x."""
    tilt = np.radians(tilt_deg)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = turn @ [0.0, 0.0, distance_mm]
    return pose


def rays(lens: Lens, base_from_camera: Transform) -> NDArray[np.float64]:
    """[h, w, 3] where every pixel looks, in the base frame: it is scipy that inverts distortion here."""
    from scipy.optimize import least_squares

    columns, rows = np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px))
    seen = (np.stack([columns, rows], axis=-1) - np.array(lens.centre_px)) / lens.focal_px
    if any(lens.distortion):
        from scipy.sparse import identity, kron

        blocks = kron(identity(seen[..., 0].size), np.ones((2, 2)))
        solved = least_squares(
            lambda xy: (distorted_points(xy.reshape(seen.shape), lens.distortion) - seen).ravel(),
            seen.ravel(),
            jac_sparsity=blocks,
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        seen = solved.x.reshape(seen.shape)
    directions = np.concatenate([seen, np.ones((*seen.shape[:2], 1))], axis=-1)
    return directions @ base_from_camera[:3, :3].T


def hits(
    corners_mm: NDArray[np.float32], origin_mm: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Number of the triangle that each ray from one point meets first, or -1: embreex's own interface."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    tree = rtcore_scene.EmbreeScene()
    TriangleMesh(tree, corners_mm)
    ways = directions.reshape(-1, 3).astype(np.float32)
    origins = np.broadcast_to(origin_mm.astype(np.float32), ways.shape).copy()
    found: NDArray[np.int32] = tree.run(origins, ways)
    return found.reshape(directions.shape[:-1])

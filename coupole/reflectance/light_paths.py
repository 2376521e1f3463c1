"""Paths of light from LEDs to an object, and from one part of the object to another. These paths are found by
rays in the object's mesh; no frame is needed.

The object is cut into patches. A few triangles represent each patch. Rays from them find the share of the half
space that other patches fill, and the light that comes directly from LEDs.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from coupole.motion.occlusion import RAY_START_MM, blocked_segments, ray_mesh
from coupole.motion.remembered import Remembered
from coupole.reflectance.extraction.lamp_sight import lit_on

Floats = NDArray[np.float64]

MOST_PATCHES = 4000
_RAYS_OF_A_TRIANGLE = 128
_POINTS = 4
"""Number of triangles that represent a patch."""
_BYTES_OF_A_TRIANGLE, _MOST_REMEMBERED_BYTES = 12 * _RAYS_OF_A_TRIANGLE, 10**9
"""Largest memory, in bytes: for one triangle of a view, and for all views together."""
_SUPPORT_CELLS = 24
_RAYS = 1_000_000


class Ahead:
    """Paths of light between surfaces, and the views' diffuse reflectance. No later view changes them, so they are
    kept for the next result of the same object in this process."""

    def __init__(self) -> None:
        self._results: Remembered[Any] = Remembered(1000)

    def result(self, count: int, key: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        """Return the value for `key`, computed from all views. It is remembered if `count` triangles of views fit
        into the memory."""
        if count * _BYTES_OF_A_TRIANGLE > _MOST_REMEMBERED_BYTES:
            return compute()
        return self._results.result(key, compute)


class _NothingAhead(Ahead):
    def result(self, count: int, key: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        return compute()


NOTHING_AHEAD = _NothingAhead()


@dataclass(frozen=True)
class Scene:
    """The object's triangles, and the triangles of the support under it if the support reflects."""

    rays: Any
    centres_mm: Floats
    """[m, 3]"""
    normals: Floats
    """[m, 3] unit, outward."""
    areas_mm2: Floats
    """[m]"""
    patch: NDArray[np.int64]
    """[m] number of a triangle's patch."""
    corners_mm: Floats

    @property
    def patches(self) -> int:
        return int(self.patch.max()) + 1


def scene_of(corners_mm: Floats, *, support_z: tuple[Floats, Floats] | None = None) -> Scene:
    """Return the scene of triangles [m, 3, 3]. If the support reflects, `support_z` is a point of the support and
    its unit normal. A square three times as wide as the object is then added to the scene."""
    count = len(corners_mm)
    if support_z is not None:
        corners_mm = np.concatenate([corners_mm, _support(corners_mm, *support_z)])
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    twice = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    centres, normals = corners_mm.mean(axis=1), across / twice[:, None]
    of_support = np.arange(len(centres)) >= count
    patch = _patches(centres, normals, of_support)
    return Scene(ray_mesh(corners_mm), centres, normals, 0.5 * twice, patch, corners_mm)


def _support(corners_mm: Floats, point_mm: Floats, normal: Floats) -> Floats:
    """[2 cells^2, 3, 3] triangles of the support."""
    flat = corners_mm.reshape(-1, 3) - (corners_mm.reshape(-1, 3) - point_mm) @ normal[:, None] * normal
    middle, half = flat.mean(axis=0), 1.5 * np.ptp(flat, axis=0).max()
    first = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, 0]
    second = np.cross(normal, first)
    steps = np.linspace(-half, half, _SUPPORT_CELLS + 1)
    grid = middle + steps[:, None, None] * first + steps[None, :, None] * second
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)


def _patches(centres_mm: Floats, normals: Floats, of_support: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return a patch number for each triangle. It follows from the triangle's cell in a grid, and from the nearest
    of six directions to its normal. The grid is as fine as the allowed number of patches permits."""
    low, size = centres_mm.min(axis=0), float(np.ptp(centres_mm, axis=0).max())
    axis = np.argmax(np.abs(normals), axis=1)
    facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    cells = 128.0
    while True:
        cell = np.floor((centres_mm - low) / max(size, 1e-9) * cells).astype(np.int64)
        key = ((cell[:, 0] * 1024 + cell[:, 1]) * 1024 + cell[:, 2]) * 12 + 6 * of_support + facing
        number = np.unique(key, return_inverse=True)[1]
        if number.max() < MOST_PATCHES or cells < 2:
            return number
        cells *= 0.8


def seen_from(scene: Scene, triangles: NDArray[np.int64], seed: int) -> csr_array:
    """[n, patches] share of the half space over some triangles, weighted by the cosine, that the front of each
    patch fills. It is found by rays from places spread over the triangle."""
    random = np.random.default_rng(seed)
    across = math.isqrt(_RAYS_OF_A_TRIANGLE // 2)
    strata = np.stack(np.divmod(np.arange(2 * across * across), 2 * across), axis=-1)
    step = max(1, _RAYS // len(strata))
    starts = range(0, len(triangles), step)
    seeds = [int(number) for number in random.integers(0, 2**31, len(starts))]

    def part(first: int, seed: int) -> csr_array:
        part_triangles = triangles[first : first + step]
        return _gather_rays(scene, part_triangles, strata, np.random.default_rng(seed))

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        parts = list(pool.map(part, starts, seeds))
    return vstack(parts, format="csr")


def _gather_rays(
    scene: Scene, triangles: NDArray[np.int64], strata: NDArray[np.int64], random: np.random.Generator
) -> csr_array:
    """Compute `seen_from` for some of the triangles, with one ray in each cell of a square that is mapped to the
    half space."""
    count, rays = len(triangles), len(strata)
    u = (strata + random.random((count, rays, 2))) / (strata.max(axis=0) + 1)
    radius, phi = np.sqrt(u[..., 0]), 2 * np.pi * u[..., 1]
    normals = scene.normals[triangles]
    first = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    x, y, z = radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - u[..., 0])
    ways = x[..., None] * first[:, None] + y[..., None] * second[:, None] + z[..., None] * normals[:, None]
    shares = random.dirichlet((1.0, 1.0, 1.0), (count, rays))
    places = np.einsum("nrc,nck->nrk", shares, scene.corners_mm[triangles]) + RAY_START_MM * normals[:, None]
    hits = scene.rays.run(
        np.ascontiguousarray(places.reshape(-1, 3), np.float32),
        np.ascontiguousarray(ways.reshape(-1, 3), np.float32),
        query="INTERSECT",
        output=1,
    )
    hit = np.asarray(hits["primID"], dtype=np.int64).reshape(count, rays)
    front = (hit >= 0) & (np.einsum("nrk,nrk->nr", ways, scene.normals[hit]) < 0)
    row, ray = np.nonzero(front)
    data = np.full(len(row), 1.0 / rays, np.float32)
    return csr_array((data, (row, scene.patch[hit[row, ray]])), shape=(count, scene.patches))


def points_of(scene: Scene) -> NDArray[np.int64]:
    """[points, patches] triangles that represent each patch, chosen among its triangles."""
    flat = scene.areas_mm2 < 1e-9 * scene.areas_mm2.max()  # has no normal
    order = np.lexsort((np.random.default_rng(3).random(len(scene.patch)), flat, scene.patch))
    first = np.searchsorted(scene.patch[order], np.arange(scene.patches))
    number = np.maximum(np.bincount(scene.patch[~flat], minlength=scene.patches), 1)
    return np.stack([order[first + point * number // _POINTS] for point in range(_POINTS)])


def direct_irradiance(scene: Scene, led_mm: Floats, led_normals: Floats, *, paper: bool) -> NDArray[np.float32]:
    """[patches, leds] E / Phi, m^-2, of patches directly from LEDs: the mean of some of their triangles."""
    irradiance = np.zeros((scene.patches, len(led_mm)), np.float32)
    for at in points_of(scene):
        centres, normals = scene.centres_mm[at], scene.normals[at]
        cosine = cosines_on(centres, normals, led_mm)
        light = lit_on(centres, led_mm, led_normals, paper) * np.maximum(cosine, 0.0)
        patch, led = np.nonzero(light > 0)
        starts = (centres + RAY_START_MM * normals)[patch]
        for part in range(0, len(patch), _RAYS):
            some = slice(part, part + _RAYS)
            light[patch[some], led[some]] *= ~blocked_segments(scene.rays, starts[some], led_mm[led[some]])
        irradiance += (light / _POINTS).astype(np.float32)
    return irradiance


def cosines_on(centres_mm: Floats, normals: Floats, led_mm: Floats) -> Floats:
    """[n, leds] cosines of incidence."""
    ways = led_mm[None] - centres_mm[:, None]
    cosines: Floats = np.einsum("nlk,nk->nl", ways, normals) / np.linalg.norm(ways, axis=2)
    return cosines


@dataclass(frozen=True)
class PathsOfLight:
    """Paths of light in a scene, from the LEDs of views to their triangles. No frames are needed."""

    scene: Scene
    key: tuple[Any, ...]
    count: int
    """Number of triangles of the scene and of all views."""
    paper: bool
    ahead: Ahead

    def form_factors(self) -> csr_array:
        """[patches, patches]"""
        points = points_of(self.scene)

        def compute() -> Any:
            return sum(seen_from(self.scene, at, seed) for seed, at in enumerate(points)) * (1.0 / len(points))

        form_factors: csr_array = self.ahead.result(self.count, ("form factors", *self.key), compute)
        return form_factors

    def direct(self, led_mm: Floats, led_normals: Floats) -> NDArray[np.float32]:
        """[patches, leds] `direct_irradiance` of the LEDs of a view."""
        direct: NDArray[np.float32] = self.ahead.result(
            self.count,
            ("direct", *self.key, led_mm, led_normals, self.paper),
            lambda: direct_irradiance(self.scene, led_mm, led_normals, paper=self.paper),
        )
        return direct

    def gathers(self, triangles: NDArray[np.int64]) -> csr_array:
        """[n, patches] share of the half space over the triangles of a view that each patch fills, by
        `seen_from`."""
        gathers: csr_array = self.ahead.result(
            self.count, ("gathers", *self.key, triangles), lambda: seen_from(self.scene, triangles, _POINTS)
        )
        return gathers


def paths_of(
    corners_mm: NDArray[np.float32],
    base_from_support: Floats,
    *,
    support_reflects: bool,
    paper: bool,
    triangles_of_views: int,
    ahead: Ahead = NOTHING_AHEAD,
) -> PathsOfLight:
    """Return the paths of light in the scene of an object, by its triangles [m, 3, 3] as a result's file has them.
    The support belongs to the scene if it reflects. `triangles_of_views` is the number of triangles of all
    views."""
    corners = corners_mm.astype(np.float64)
    support = (base_from_support[:3, 3], base_from_support[:3, 2]) if support_reflects else None
    count = len(corners) + triangles_of_views
    key = (hashlib.sha256(corners.tobytes()).hexdigest(), support_reflects)
    scene: Scene = ahead.result(count, ("scene", *key), lambda: scene_of(corners, support_z=support))
    return PathsOfLight(scene, key, count, paper, ahead)

"""The caustic of sunlight in a gilded niche on stone, by photon tracing (Callet et al. 2010, figure 9).

Photons start evenly over the opening, are reflected each time they hit gold, and stop where they hit
stone: the first pass of photon mapping (Jensen 1999). A photon carries all 81 bands, because reflection has no
dispersion. It is reflected at GGX microfacets sampled by visible area (Heitz, JCGT 7(4), 2018), and weighted with
Fresnel's reflectance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import flat_normals, weld_corners
from coupole.appearance.spectra.grid import BANDS, Array

Reflectance = Callable[[Array], Array]
"""Cosines [n] to reflectances [n, 81]."""
_MOST_BOUNCES = 64
_CHUNK = 100_000
_OFFSET_MM = 0.05


@dataclass(frozen=True)
class Niche:
    """Surfaces for photons: gold reflects, stone stops them; corners [triangles, 3, 3], mm."""

    gilded_mm: Array
    stone_mm: Array
    reflectance: Reflectance
    """Reflectance of the gold."""
    roughness: float
    """GGX alpha of the gold; 0 for a mirror."""


@dataclass(frozen=True)
class Sun:
    direction: Array
    """[3] unit direction in which light travels: into the opening, towards +y."""
    width_deg: float
    irradiance: Array
    """[81] irradiance, W/(m^2 nm), on a surface that faces the sun."""


@dataclass(frozen=True)
class Photons:
    """The n photons that stopped on stone, and the power balance of all."""

    places_mm: Array
    """[n, 3]."""
    power: NDArray[np.float32]
    """[n, 81], W/nm."""
    bounces: NDArray[np.int64]
    """[n] number of reflections of each photon at gold."""
    started_power: Array
    """[81] power of all photons together, W/nm."""
    escaped_power: Array
    """[81] power that left the niche again, W/nm. Gold absorbed the remainder."""


def photons(
    niche: Niche, sun: Sun, opening_mm: tuple[float, float, float], count: int, seed: int | tuple[int, ...]
) -> Photons:
    """Trace `count` photons that pass a rectangle in y = 0: x from `opening_mm[0]` to [1], z from 0 to [2]."""
    ray_tracer = _Met(niche)
    left_mm, right_mm, top_mm = opening_mm
    area_m2 = (right_mm - left_mm) * top_mm * 1e-6
    facing = sun.irradiance * area_m2 / count
    random = np.random.default_rng(seed)
    parts, started_power, escaped_power = [], np.zeros(BANDS), np.zeros(BANDS)
    for first in range(0, count, _CHUNK):
        n = min(_CHUNK, count - first)
        starts = np.stack(
            [random.uniform(left_mm, right_mm, n), np.zeros(n), random.uniform(0.0, top_mm, n)], axis=1
        )
        ways = sun_directions(sun, random, n)
        # Sampled uniformly over the sun's disk; the weight is the opening's projected area for each direction.
        shares = np.maximum(0.0, ways[:, 1]) / (ways @ sun.direction)
        power = (shares[:, None] * facing).astype(np.float32)
        started_power += power.sum(axis=0, dtype=float)
        # Start slightly outside, so that the wall around the opening can stop them.
        part, lost_power = _trace_photons(ray_tracer, starts - ways, ways, power, random)
        parts.append(part)
        escaped_power += lost_power
    places, powers, bounces = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Photons(places, powers, bounces, started_power, escaped_power)


def irradiance(
    stopped_photons: Photons, width_mm: tuple[float, float], height_mm: float, cell_mm: float, y_mm: float
) -> Array:
    """[rows, columns, 81] W/(m^2 nm) on the plane y = `y_mm`, with x over `width_mm` and z from 0 to `height_mm`;
    the top row is first."""
    from scipy.sparse import csr_matrix

    columns, rows = round((width_mm[1] - width_mm[0]) / cell_mm), round(height_mm / cell_mm)
    place = np.floor((stopped_photons.places_mm[:, [0, 2]] - [width_mm[0], 0.0]) / cell_mm).astype(int)
    inside = (np.abs(stopped_photons.places_mm[:, 1] - y_mm) < 0.5) & np.all(
        (place >= 0) & (place < [columns, rows]), axis=1
    )
    cell = (rows - 1 - place[inside, 1]) * columns + place[inside, 0]
    here = np.flatnonzero(inside)
    gather = csr_matrix((np.ones(len(here), np.float32), (cell, here)), (rows * columns, len(inside)))
    total = np.asarray(gather @ stopped_photons.power, dtype=float)
    return total.reshape(rows, columns, BANDS) / (cell_mm**2 * 1e-6)


class _Met:
    """Embree's tree of the niche, and the smooth normals of the gold."""

    def __init__(self, niche: Niche) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.niche = niche
        self._tree: Any = rtcore_scene.EmbreeScene()
        self._corners = np.concatenate([niche.gilded_mm, niche.stone_mm]).astype(np.float32)
        self._mesh = TriangleMesh(self._tree, self._corners)
        self._normals = smooth_normals(niche.gilded_mm)

    def first(self, starts: Array, ways: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return triangle [n] (-1 for none), distance [n] and smooth normal [n, 3] at the first gold that each ray
        meets."""
        hit = self._tree.run(starts.astype(np.float32), ways.astype(np.float32), output=True)
        triangle = np.where(hit["primID"] == -1, -1, hit["primID"]).astype(np.int64)
        normals = np.zeros_like(starts)
        gold = (triangle >= 0) & (triangle < len(self._normals))
        u, v = (np.asarray(hit[name], dtype=float)[gold, None] for name in "uv")
        corners = self._normals[triangle[gold]]
        smooth = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        normals[gold] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
        return triangle, np.asarray(hit["tfar"], dtype=float), normals


def smooth_normals(corners_mm: Array) -> Array:
    """[triangles, 3, 3] unit normals at the corners [triangles, 3, 3]: means over the triangles that share a
    corner."""
    points, faces = weld_corners(corners_mm)
    sums = np.zeros_like(points)
    np.add.at(sums, faces.ravel(), np.repeat(flat_normals(corners_mm), 3, axis=0))
    return np.asarray((sums / np.linalg.norm(sums, axis=1, keepdims=True))[faces])


def _trace_photons(
    intersector: _Met, starts: Array, ways: Array, power: NDArray[np.float32], random: np.random.Generator
) -> tuple[tuple[Array, NDArray[np.float32], NDArray[np.int64]], Array]:
    places, powers, bounces = [], [], []
    escaped_power = np.zeros(BANDS)
    gold_count = len(intersector.niche.gilded_mm)
    for bounce in range(_MOST_BOUNCES):
        triangle, distance, normals = intersector.first(starts, ways)
        here = starts + distance[:, None] * ways
        escaped_power += power[triangle < 0].sum(axis=0, dtype=float)
        stone, gold = triangle >= gold_count, (triangle >= 0) & (triangle < gold_count)
        places.append(here[stone])
        powers.append(power[stone])
        bounces.append(np.full(np.count_nonzero(stone), bounce))
        if not gold.any():
            break
        facing = np.where(np.sum(normals[gold] * ways[gold], axis=1) > 0.0, -1.0, 1.0)[:, None] * normals[gold]
        new_ways, share = reflect_at_gold(
            ways[gold], facing, intersector.niche.reflectance, intersector.niche.roughness, random
        )
        alive = np.sum(new_ways * facing, axis=1) > 0.0
        power = (power[gold] * share)[alive].astype(np.float32)
        starts, ways = (here[gold] + _OFFSET_MM * facing)[alive], new_ways[alive]
    return (np.concatenate(places), np.concatenate(powers), np.concatenate(bounces)), escaped_power


def reflect_at_gold(
    ways: Array, normals: Array, reflectance: Reflectance, roughness: float, random: np.random.Generator
) -> tuple[Array, Array]:
    """Directions [n, 3] after reflection at gold, and reflectances [n, 81]."""
    facets = normals
    if roughness > 0.0:
        facets = _facets(-ways, normals, roughness, random)
    cosines = np.clip(-np.sum(ways * facets, axis=1), 0.0, 1.0)
    new_ways = ways + 2.0 * cosines[:, None] * facets
    share = reflectance(cosines)
    if roughness > 0.0:
        share = share * _unmasked_share(np.sum(new_ways * normals, axis=1), roughness)[:, None]
    return new_ways, share


def _facets(towards: Array, normals: Array, alpha: float, random: np.random.Generator) -> Array:
    """Return normals [n, 3] of facets as seen from `towards` [n, 3], uniform on the disk of Heitz 2018, listing
    1."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    t1 = np.cross(helper, normals)
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    t2 = np.cross(normals, t1)
    local = np.stack([np.sum(towards * axis, axis=1) for axis in (t1, t2, normals)], axis=1)
    view = local * [alpha, alpha, 1.0]
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    flat = np.hypot(view[:, 0], view[:, 1])
    flat_or_one = np.where(flat > 0.0, flat, 1.0)
    e1 = np.stack([-view[:, 1] / flat_or_one, view[:, 0] / flat_or_one, 0.0 * flat], axis=1)
    e1[flat == 0.0] = [1.0, 0.0, 0.0]
    e2 = np.cross(view, e1)
    radius, phi = np.sqrt(random.random(len(view))), 2.0 * np.pi * random.random(len(view))
    p1, p2 = radius * np.cos(phi), radius * np.sin(phi)
    s = 0.5 * (1.0 + view[:, 2])
    p2 = (1.0 - s) * np.sqrt(np.maximum(0.0, 1.0 - p1**2)) + s * p2
    p3 = np.sqrt(np.maximum(0.0, 1.0 - p1**2 - p2**2))
    h = p1[:, None] * e1 + p2[:, None] * e2 + p3[:, None] * view
    h *= [alpha, alpha, 1.0]
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    return np.asarray(h[:, :1] * t1 + h[:, 1:2] * t2 + h[:, 2:] * normals)


def _unmasked_share(cosine: Array, alpha: float) -> Array:
    """Return Smith's G1 of GGX, which is G2/G1 for separable masking."""
    c = np.maximum(cosine, 0.0)
    return np.asarray(2.0 * c / np.maximum(c + np.sqrt(alpha**2 + (1.0 - alpha**2) * c**2), 1e-12))


def sun_directions(sun: Sun, random: np.random.Generator, count: int) -> Array:
    """Directions [count, 3] of light from the sun's disk."""
    sine = np.sin(np.radians(sun.width_deg / 2)) * np.sqrt(random.random(count))
    phi = 2.0 * np.pi * random.random(count)
    t1 = np.cross(sun.direction, [0.0, 0.0, 1.0])
    t1 /= np.linalg.norm(t1)
    t2 = np.cross(sun.direction, t1)
    across = sine[:, None] * (np.cos(phi)[:, None] * t1 + np.sin(phi)[:, None] * t2)
    return np.asarray(across + np.sqrt(1.0 - sine**2)[:, None] * sun.direction)

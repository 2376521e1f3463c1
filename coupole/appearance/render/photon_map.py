"""Sunlight that gold reflects onto matt surfaces: photons are kept there and gathered by the eye.

Photon mapping (Jensen 1996) is used for light that path tracing finds only by chance. Photons start at the sun.
Gold reflects them as in `caustic`, and matt surfaces reflect them with Lambert's distribution. They are kept at
each matt surface that they meet after gold. All light is the sum of this light and the light of paths without
gold, which a path tracer finds well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render.caustic import Reflectance, Sun, reflect_at_gold, smooth_normals, sun_directions
from coupole.appearance.render.scene_file import Gathered
from coupole.appearance.shapes.triangles import flat_normals
from coupole.appearance.spectra.grid import Array

_MOST_BOUNCES = 32
_CHUNK = 100_000
_OFFSET_MM = 0.05
_SAME_SIDE = 0.5
"""Least cosine between the normals of an eye's hit and of a photon that it gathers."""


@dataclass(frozen=True)
class Mirror:
    corners_mm: Array
    """[triangles, 3, 3]."""
    reflectance: Reflectance
    """Function that returns the reflectance [n, 81] for cosines [n]."""
    roughness: float


@dataclass(frozen=True)
class Matt:
    corners_mm: Array
    """[triangles, 3, 3]."""
    reflectance: Array
    """[81]."""


@dataclass(frozen=True)
class Hits:
    """Ends of rays. Rays that meet nothing have surface -1."""

    surface: NDArray[np.int64]
    """[n] number of the surface that each ray meets."""
    places_mm: Array
    """[n, 3]."""
    normals: Array
    """[n, 3] normals on the side from which the ray came."""


@dataclass(frozen=True)
class Kept:
    """Photons that reached matt surfaces after a reflection at gold."""

    places_mm: Array
    """[n, 3]."""
    normals: Array
    """[n, 3]."""
    power: NDArray[np.float32]
    """[n, bands], W/nm."""


class Room:
    """Surfaces that rays meet."""

    def __init__(self, surfaces: Sequence[Mirror | Matt]) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.surfaces = surfaces
        corners = np.concatenate([surface.corners_mm for surface in surfaces])
        counts = [len(surface.corners_mm) for surface in surfaces]
        self._surface = np.repeat(np.arange(len(surfaces)), counts)
        self._normals = np.concatenate(
            [
                smooth_normals(room_surface.corners_mm)
                if isinstance(room_surface, Mirror)
                else np.repeat(flat_normals(room_surface.corners_mm)[:, None], 3, axis=1)
                for room_surface in surfaces
            ]
        )
        self._tree: Any = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._tree, corners.astype(np.float32))
        mirrors = np.concatenate(
            [
                room_surface.corners_mm.reshape(-1, 3)
                for room_surface in surfaces
                if isinstance(room_surface, Mirror)
            ]
        )
        self.box_mm = np.stack([mirrors.min(axis=0), mirrors.max(axis=0)])
        """[2, 3], bounds of the mirrors."""

    def hits(self, starts: Array, ways: Array) -> Hits:
        hit = self._tree.run(starts.astype(np.float32), ways.astype(np.float32), output=True)
        triangle = np.asarray(hit["primID"]).astype(np.int64)
        is_hit = triangle != -1
        u, v = (np.asarray(hit[name], dtype=float)[:, None] for name in "uv")
        corners = self._normals[triangle]
        normals = (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        normals *= np.where(np.sum(normals * ways, axis=1) > 0.0, -1.0, 1.0)[:, None]
        far = np.where(is_hit, np.asarray(hit["tfar"], dtype=float), 0.0)
        return Hits(np.where(is_hit, self._surface[triangle], -1), starts + far[:, None] * ways, normals)


def photons(room: Room, sun: Sun, bands: Sequence[int], count: int, seed: tuple[int, ...]) -> Iterator[Kept]:
    """Yield, in parts, `count` photons from the sun onto the mirrors and their surroundings. The photons of all
    parts together have the full power."""
    random = np.random.default_rng(seed)
    middle = room.box_mm.mean(axis=0)
    radius_mm = 0.75 * float(np.linalg.norm(room.box_mm[1] - room.box_mm[0]))
    helper = np.array([0.0, 0.0, 1.0]) if abs(sun.direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(sun.direction, helper)
    right /= np.linalg.norm(right)
    above = np.cross(right, sun.direction)
    photon_power = sun.irradiance[list(bands)] * (np.pi * (radius_mm * 1e-3) ** 2 / count)
    for first in range(0, count, _CHUNK):
        n = min(_CHUNK, count - first)
        out, turn = radius_mm * np.sqrt(random.random(n)), 2.0 * np.pi * random.random(n)
        across = (out * np.cos(turn))[:, None] * right + (out * np.sin(turn))[:, None] * above
        ways = sun_directions(sun, random, n)
        starts = middle + across - 10.0 * radius_mm * ways
        yield _trace_photons(
            room, starts, ways, np.tile(photon_power.astype(np.float32), (n, 1)), list(bands), random
        )


def _trace_photons(
    room: Room,
    starts: Array,
    ways: Array,
    power: NDArray[np.float32],
    bands: list[int],
    random: np.random.Generator,
) -> Kept:
    deposits: list[tuple[Array, Array, NDArray[np.float32]]] = []
    by_gold = np.zeros(len(starts), dtype=bool)
    for _ in range(_MOST_BOUNCES):
        hits = room.hits(starts, ways)
        onward: list[tuple[Array, Array, NDArray[np.float32], NDArray[np.bool_]]] = []
        for number, surface in enumerate(room.surfaces):
            here = hits.surface == number
            if not here.any():
                continue
            places, normals = hits.places_mm[here], hits.normals[here]
            if isinstance(surface, Matt):
                stays = here & by_gold
                deposits.append((hits.places_mm[stays], hits.normals[stays], power[stays]))
                new_ways, share = _scatter_diffusely(normals, surface.reflectance[bands], random)
            else:
                new_ways, share = reflect_at_gold(
                    ways[here], normals, surface.reflectance, surface.roughness, random
                )
                share = share[:, bands]
            alive = (np.sum(new_ways * normals, axis=1) > 0.0) & share.any(axis=1)
            onward_power = (power[here] * share)[alive].astype(np.float32)
            gold = by_gold[here][alive] | isinstance(surface, Mirror)
            onward.append((places[alive] + _OFFSET_MM * normals[alive], new_ways[alive], onward_power, gold))
        if not onward or not sum(len(part[0]) for part in onward):
            break
        starts, ways, power, by_gold = (np.concatenate(column) for column in zip(*onward, strict=True))
    places, normals, powers = (
        (np.concatenate(column) for column in zip(*deposits, strict=True))
        if deposits
        else (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, len(bands)), np.float32))
    )
    return Kept(places, normals, powers)


def _scatter_diffusely(normals: Array, reflectance: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Return Lambertian directions [n, 3], and shares of power [n, bands], which are 0 for photons that Russian
    roulette ends."""
    n, lives = len(normals), float(min(1.0, max(reflectance.max(), 0.0)))
    ball = random.normal(size=(n, 3))
    ways = normals + ball / np.linalg.norm(ball, axis=1, keepdims=True)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    goes_on = random.random(n) < lives
    return ways, goes_on[:, None] * (reflectance / max(lives, 1e-9))


class Gathering:
    """Irradiance from photons at the hits of an eye's rays, summed over parts of the photons."""

    def __init__(self, hits: Hits, is_matt: NDArray[np.bool_], bands: int, radius_mm: float) -> None:
        from scipy.spatial import cKDTree

        self._normals = hits.normals[is_matt]
        self._tree: Any = cKDTree(hits.places_mm[is_matt])
        self._radius_mm = radius_mm
        self._sums = np.zeros((len(self._normals), bands), np.float32)

    def add(self, kept_photons: Kept) -> None:
        from scipy.sparse import csr_matrix
        from scipy.spatial import cKDTree

        if not len(kept_photons.places_mm):
            return
        near = self._tree.sparse_distance_matrix(
            cKDTree(kept_photons.places_mm), self._radius_mm, output_type="coo_matrix"
        )
        same = np.sum(self._normals[near.row] * kept_photons.normals[near.col], axis=1) > _SAME_SIDE
        weights = csr_matrix(
            (np.ones(int(same.sum()), np.float32), (near.row[same], near.col[same])), shape=near.shape
        )
        self._sums += weights @ kept_photons.power

    def irradiance(self) -> Array:
        """[matt hits, bands], W/(m^2 nm)."""
        return np.asarray(self._sums / (np.pi * (self._radius_mm * 1e-3) ** 2), dtype=float)


Progress = Callable[[int, int], None]


def seen_by_gold(
    room: Room,
    suns: Sequence[Sun],
    rays: tuple[Array, Array],
    bands: Sequence[int],
    gathering_settings: Gathered,
    seed: int,
    progress: Progress,
) -> tuple[Array, NDArray[np.bool_]]:
    """Return, for rays of an eye (starts [n, 3], directions [n, 3]), the radiance [n, bands] of matt surfaces from
    light that gold reflected, in W/(m^2 sr nm). Return also a mask [n] of the rays that meet gold first."""
    hits = room.hits(*rays)
    albedo = np.stack(
        [surface.reflectance if isinstance(surface, Matt) else np.zeros(81) for surface in room.surfaces]
    )[:, list(bands)]
    mirrors = np.array([isinstance(surface, Mirror) for surface in room.surfaces])
    is_gold = (hits.surface >= 0) & mirrors[hits.surface]
    is_matt = (hits.surface >= 0) & ~is_gold
    gathering = Gathering(hits, is_matt, len(list(bands)), gathering_settings.radius_mm)
    total, photons_done = len(suns) * gathering_settings.photons, 0
    for number, sun in enumerate(suns):
        for part in photons(room, sun, bands, gathering_settings.photons, (seed, number)):
            progress(photons_done, total)
            gathering.add(part)
            photons_done += _CHUNK
    progress(total, total)
    radiance = np.zeros((len(hits.surface), len(list(bands))))
    radiance[is_matt] = gathering.irradiance() * albedo[hits.surface[is_matt]] / np.pi
    return radiance, is_gold

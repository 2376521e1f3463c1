"""Interreflection: light that meets two or more surfaces, from patch to patch (radiosity by final gathering).

The scene's triangles are grouped into patches of like normal. Rays from points on both sides of each patch, in a
cosine distribution, find once which sides of other patches it sees. Then, for each light, the irradiance of all
patches is gathered bounce by bounce. A side receives the mean over its rays of the light that the others reflect.

All surfaces reflect this light as if they were diffuse, with the sum of their diffuse reflectance and their
reflectance along the normal. This is right for matt surfaces, an approximation for glossy ones, and wrong in
direction for mirrors. Concave places finer than patches, normals for shading and detail finer than the mesh are
left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from sim.render import arm_shadow
from sim.render.embree import OFFSET_MM, Obstacles, centroid_and_normal
from sim.render.emitter import Emitter, irradiance
from sim.scene.scene import Scene

POINTS = 2
"""Points on each side of a patch where its light is computed."""
PATCHES_OF_A_MATERIAL = 1000
"""The size of patches follows from the area of all triangles of a material divided by this number."""
_NEIGHBOURS = 8
_LEAST_WEIGHT = 1e-6
_CELL_BITS, _OFFSET_CELLS = 16, 1 << 15
_CHUNK = 4096


@dataclass(frozen=True)
class Exchange:
    """Patches of a scene, and what each side sees. Row 2 p is the front of patch p, row 2 p + 1 its back."""

    patch: NDArray[np.int32]
    """[triangles]."""
    points_mm: NDArray[np.float32]
    """[2 patches * POINTS, 3] points at which light is computed."""
    normals: NDArray[np.float32]
    """[2 patches * POINTS, 3] flat unit normals there."""
    albedo: NDArray[np.float32]
    """[2 patches, 3]."""
    seen_sides: NDArray[np.int32]
    """[2 patches, rays] side that each ray meets, or -1."""
    neighbours: NDArray[np.int32]
    """[patches, _NEIGHBOURS] nearest patches of the same material, itself first; filled up with itself."""
    centres_mm: NDArray[np.float32]
    """[patches, 3]."""
    facing: NDArray[np.float32]
    """[patches, 3] unit normal of the front."""
    cells_mm: NDArray[np.float32]
    """[patches] size."""


@dataclass(frozen=True)
class Neighbourhood:
    """Sides of patches around each triangle of a view, with weights of sum 1."""

    sides: NDArray[np.int32]
    """[seen, _NEIGHBOURS]."""
    weights: NDArray[np.float32]
    """[seen, _NEIGHBOURS]."""


def exchange(scene: Scene, obstacles: Obstacles, rays: int) -> Exchange:
    """Divide a scene into patches, and trace `rays`, rounded up to a multiple of POINTS, from each side."""
    key, cells_mm = _keys(scene)
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    patch = np.empty(len(order), np.int32)
    patch[order] = np.repeat(np.arange(len(starts), dtype=np.int32), counts)
    # Evenly among the patch's triangles, in the order of the mesh.
    shares = (np.arange(POINTS) + 0.5) / POINTS
    members = order[starts[:, None] + (shares * counts[:, None]).astype(np.int64)]
    points, normals = np.empty((2, len(starts), 2, POINTS, 3), np.float32)
    _place(scene.corners_mm, members, points, normals)
    facing = normals[:, 0].sum(axis=1)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), np.float32(1e-9))
    material = scene.material[order[starts]]
    diffuse = scene.materials[material, :3]
    if scene.tint is not None:
        diffuse = diffuse * np.add.reduceat(scene.tint[order].astype(np.float64), starts, axis=0) / counts[:, None]
    albedo = np.repeat((diffuse + scene.materials[material, 3:6]).astype(np.float32), 2, axis=0)
    centres = points[:, 0].mean(axis=1)
    side_seen = _sides_met(obstacles, points.reshape(-1, 3), normals.reshape(-1, 3), patch, -(-rays // POINTS))
    return Exchange(
        patch,
        points.reshape(-1, 3),
        normals.reshape(-1, 3),
        albedo,
        side_seen.reshape(2 * len(starts), -1),
        _neighbours(centres, material),
        centres,
        facing,
        cells_mm[material].astype(np.float32),
    )


def neighbourhood(
    between: Exchange, corners_mm: NDArray[np.float32], sides: NDArray[np.int64], normals: NDArray[np.float32]
) -> Neighbourhood:
    """Return the neighbourhood in which light from other surfaces is interpolated, for sides [seen] of triangles
    as in `View`."""
    shape = (len(sides), _NEIGHBOURS)
    table = Neighbourhood(np.empty(shape, np.int32), np.empty(shape, np.float32))
    _weigh(
        corners_mm,
        sides,
        normals,
        between.patch,
        between.neighbours,
        between.centres_mm,
        between.facing,
        between.cells_mm,
        table.sides,
        table.weights,
    )
    return table


def indirect_lux(
    between: Exchange,
    obstacles: Obstacles,
    emitter: Emitter,
    emission: str,
    arm_mm: NDArray[np.float64],
    bounces: int,
) -> NDArray[np.float32]:
    """Return [sides, 3], lux of light that comes from other surfaces: it has met at least 1 and at most `bounces`
    - 1 of them. `arm_mm` are capsules in its way."""
    direct = irradiance(emitter, between.points_mm, between.normals, emission)
    lit = np.repeat(direct.astype(np.float32)[:, None], 3, axis=1)
    rows = np.arange(len(lit), dtype=np.int32)
    obstacles.cast(lit, between.points_mm, rows, between.normals, emitter.centre_mm)
    arm_shadow.cast(lit, between.points_mm, arm_mm, emitter.centre_mm)
    sent_lux = lit.reshape(-1, POINTS, 3).mean(axis=1) * between.albedo
    total: NDArray[np.float32] = np.zeros_like(sent_lux)
    for _ in range(bounces - 1):
        received_lux = np.empty_like(sent_lux)
        _gather_light(between.seen_sides, sent_lux, received_lux)
        total += received_lux
        sent_lux = received_lux * between.albedo
    return total


def add_indirect(
    radiance: NDArray[np.float32],
    lux: NDArray[np.float32],
    around: Neighbourhood,
    albedo: NDArray[np.float32],
    triangle: NDArray[np.int32],
) -> None:
    """Add to `radiance` [sites, 3] the radiance that the irradiances `lux` [sides, 3] of patches' sides cause at
    sites. The sites have `albedo` [sites, 3] and lie on the view's triangles [sites]."""
    of_triangle = np.empty((len(around.sides), 3), np.float32)
    _interpolate(around.sides, around.weights, lux, of_triangle)
    _add(radiance, of_triangle, albedo, triangle)


def _keys(scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """A number for each triangle [triangles], equal within a patch; and the size of each material's patches."""
    count = len(scene.corners_mm)
    area, key = np.empty(count, np.float32), np.empty(count, np.int64)
    _areas(scene.corners_mm, area)
    of_material = np.bincount(scene.material, area.astype(np.float64), len(scene.materials))
    cells_mm = np.maximum(np.sqrt(of_material / PATCHES_OF_A_MATERIAL), 1e-3)
    # The cells' numbers must fit into their bits, however thinly a material is spread over the scene.
    reach_mm = float(np.abs(scene.corners_mm).max(initial=1.0))
    cells_mm = np.maximum(cells_mm, 1.01 * reach_mm / _OFFSET_CELLS)
    _find_keys(scene.corners_mm, scene.material, cells_mm, key)
    return key, cells_mm


def _neighbours(centres_mm: NDArray[np.float32], material: NDArray[np.int32]) -> NDArray[np.int32]:
    from scipy.spatial import cKDTree

    neighbours = np.repeat(np.arange(len(centres_mm), dtype=np.int32)[:, None], _NEIGHBOURS, axis=1)
    for number in np.unique(material):
        members = np.flatnonzero(material == number)
        near = cKDTree(centres_mm[members]).query(centres_mm[members], k=np.arange(1, _NEIGHBOURS + 1))[1]
        # cKDTree uses the number of points for missing neighbours.
        neighbours[members] = np.where(
            near < len(members), members[np.minimum(near, len(members) - 1)], members[:, None]
        )
    return neighbours


def _sides_met(
    obstacles: Obstacles,
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    patch: NDArray[np.int32],
    rays: int,
) -> NDArray[np.int32]:
    """[points, rays] side of a patch that each ray meets, or -1."""
    side_of_ray = np.empty((len(points), rays), np.int32)
    block = max(1, (1 << 22) // rays)
    for first in range(0, len(points), block):
        part = slice(first, min(len(points), first + block))
        origins, ways = np.empty((2, (part.stop - first) * rays, 3), np.float32)
        _aim(points[part], normals[part], first, rays, origins, ways)
        hits = obstacles.first_met(origins, ways)
        side = np.where(hits >= 0, 2 * patch[hits >> 1] + (hits & 1), -1)
        side_of_ray[part] = side.reshape(-1, rays)
    return side_of_ray


@kernel(parallel=True)
def _areas(corners, area):  # type: ignore[no-untyped-def]
    for t in numba.prange(len(area)):
        square = 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            first_product = np.float64(corners[t, 1, i] - corners[t, 0, i]) * np.float64(
                corners[t, 2, j] - corners[t, 0, j]
            )
            two = np.float64(corners[t, 1, j] - corners[t, 0, j]) * np.float64(corners[t, 2, i] - corners[t, 0, i])
            square += (first_product - two) * (first_product - two)
        area[t] = 0.5 * np.sqrt(square)


@kernel(parallel=True)
def _find_keys(corners, material, cells, key):  # type: ignore[no-untyped-def]
    """Material, cell, and the axis to which the normal is nearest, with its sign."""
    for chunk in numba.prange(-(-len(key) // _CHUNK)):
        centroid, normal = np.empty(3), np.empty(3)
        for t in range(chunk * _CHUNK, min(len(key), (chunk + 1) * _CHUNK)):
            centroid_and_normal(corners, t, centroid, normal)
            number, axis = np.int64(material[t]), 0
            for k in range(3):
                cell = np.int64(np.floor(centroid[k] / cells[material[t]])) + _OFFSET_CELLS
                number = (number << _CELL_BITS) | cell
                if abs(normal[k]) > abs(normal[axis]):
                    axis = k
            key[t] = number * 6 + 2 * axis + (normal[axis] < 0.0)


@kernel
def _place(corners, chosen_triangles, points, normals):  # type: ignore[no-untyped-def]
    centroid, normal = np.empty(3), np.empty(3)
    for patch in range(len(chosen_triangles)):
        for number in range(chosen_triangles.shape[1]):
            centroid_and_normal(corners, chosen_triangles[patch, number], centroid, normal)
            for k in range(3):
                points[patch, 0, number, k] = points[patch, 1, number, k] = centroid[k]
                normals[patch, 0, number, k], normals[patch, 1, number, k] = normal[k], -normal[k]


@kernel(parallel=True)
def _aim(points, normals, first, rays, origins, ways):  # type: ignore[no-untyped-def]
    """Make rays from points, which are numbered from `first` on, in a cosine distribution. Points are spread
    evenly over a disk, and projected up onto the hemisphere. The points of a side share a Fibonacci spiral, which
    is turned by an angle of its own.
    """
    total, golden = rays * POINTS, np.pi * (3.0 - np.sqrt(5.0))
    for p in numba.prange(len(points)):
        nx, ny, nz = np.float64(normals[p, 0]), np.float64(normals[p, 1]), np.float64(normals[p, 2])
        # Duff et al., Building an orthonormal basis, revisited, 2017.
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        side = (first + p) // POINTS
        turn = 2.0 * np.pi * ((side * 0.7548776662466927) % 1.0)
        for ray in range(rays):
            number = ray * POINTS + (first + p) % POINTS
            share = (number + 0.5) / total
            x, y = np.sqrt(share) * np.cos(number * golden + turn), np.sqrt(share) * np.sin(number * golden + turn)
            z, at = np.sqrt(1.0 - share), p * rays + ray
            ways[at, 0] = x * (1.0 + sign * nx * nx * a) + y * b + z * nx
            ways[at, 1] = x * sign * b + y * (sign + ny * ny * a) + z * ny
            ways[at, 2] = -x * sign * nx - y * ny + z * nz
            for k in range(3):
                origins[at, k] = points[p, k] + OFFSET_MM * normals[p, k]


@kernel(parallel=True)
def _gather_light(seen_sides, sent_light, received_light):  # type: ignore[no-untyped-def]
    for side in numba.prange(len(seen_sides)):
        red, green, blue = 0.0, 0.0, 0.0
        for ray in range(seen_sides.shape[1]):
            source_side = seen_sides[side, ray]
            if source_side >= 0:
                red, green, blue = (
                    red + sent_light[source_side, 0],
                    green + sent_light[source_side, 1],
                    blue + sent_light[source_side, 2],
                )
        rays = seen_sides.shape[1]
        received_light[side, 0], received_light[side, 1], received_light[side, 2] = (
            red / rays,
            green / rays,
            blue / rays,
        )


@kernel(parallel=True)
def _weigh(corners, sides, normals, patch, neighbours, centres, facing, cells, side_numbers, weights):  # type: ignore[no-untyped-def]
    """Compute the weights: a smooth bump two patches wide, times the agreement of the normals."""
    for chunk in numba.prange(-(-len(sides) // _CHUNK)):
        centroid, normal = np.empty(3), np.empty(3)
        for i in range(chunk * _CHUNK, min(len(sides), (chunk + 1) * _CHUNK)):
            centroid_and_normal(corners, sides[i] >> 1, centroid, normal)
            back = sides[i] & 1
            own_patch, total = patch[sides[i] >> 1], 0.0
            for n in range(neighbours.shape[1]):
                neighbour = neighbours[own_patch, n]
                squared_distance, agree = 0.0, 0.0
                for k in range(3):
                    squared_distance += (centroid[k] - centres[neighbour, k]) ** 2
                    agree += normal[k] * facing[neighbour, k]
                reach = 2.0 * np.float64(cells[own_patch])
                weight = max(0.0, 1.0 - squared_distance / (reach * reach)) ** 2 * max(0.0, agree) ** 4
                if n > 0 and neighbour == own_patch:
                    weight = 0.0
                side_numbers[i, n], weights[i, n] = 2 * neighbour + back, weight
                total += weight
            if total < _LEAST_WEIGHT:
                weights[i, :] = 0.0
                weights[i, 0], total = 1.0, 1.0
            for n in range(neighbours.shape[1]):
                weights[i, n] /= total


@kernel(parallel=True)
def _interpolate(sides, weights, lux, out):  # type: ignore[no-untyped-def]
    for i in numba.prange(len(out)):
        red, green, blue = 0.0, 0.0, 0.0
        for n in range(sides.shape[1]):
            side, weight = sides[i, n], weights[i, n]
            red, green, blue = (
                red + weight * lux[side, 0],
                green + weight * lux[side, 1],
                blue + weight * lux[side, 2],
            )
        out[i, 0], out[i, 1], out[i, 2] = red, green, blue


@kernel(parallel=True)
def _add(radiance, lux, albedo, triangle):  # type: ignore[no-untyped-def]
    for i in numba.prange(len(radiance)):
        for k in range(3):
            radiance[i, k] += lux[triangle[i], k] * albedo[i, k] * np.float32(1.0 / np.pi)

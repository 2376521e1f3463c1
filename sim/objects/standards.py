"""Calibration targets: white tile, grey card, glare target, chrome ball, stickers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import Array, disk, flat_normals, rectangle, skirt
from coupole.errors import InputError
from sim.objects import appearance
from sim.objects.shapes import sphere
from sim.objects.surfaces import joined_surface, moved_surface, of_material
from sim.scene.surface import Material, Surface

_SEGMENTS = 48
_BORDER = 10.0 / 6.0
"""Ratio of a sticker's diameter to the diameter of its bright disk."""
_THICKNESS_MM = 0.05
_CELL_MM = 2.0
_TRAPS_MM = tuple(
    (x_mm, y_mm, side_mm)
    for row, y_mm in enumerate((-46.0, 0.0, 46.0))
    for x_mm, side_mm in zip(
        (-64.0, 0.0, 64.0), ((12.0, 28.0, 12.0), (20.0, 12.0, 20.0), (12.0, 28.0, 12.0))[row], strict=True
    )
)
"""Middle and side of each trap of the glare target."""
_TRIES = 20_000


def spectralon_tile(side_mm: float = 50.0, *, thickness_mm: float = 10.0) -> Surface:
    """A square tile of Spectralon standing on z = 0; its white face is at z = `thickness_mm`."""
    return _tile(side_mm, side_mm, thickness_mm, appearance.SPECTRALON)


def grey_card(width_mm: float = 210.0, depth_mm: float = 148.0, *, thickness_mm: float = 2.0) -> Surface:
    """A card of 18 % reflectance standing on z = 0; its face is at z = `thickness_mm`."""
    return _tile(width_mm, depth_mm, thickness_mm, appearance.GREY_CARD)


def glare_target(width_mm: float = 240.0, depth_mm: float = 180.0, *, thickness_mm: float = 2.0) -> Surface:
    """A white card standing on z = 0 with nine square black traps of three sizes; its face is at z =
    `thickness_mm`."""
    columns, rows = (round(length_mm / _CELL_MM) for length_mm in (width_mm, depth_mm))
    face = rectangle(width_mm, depth_mm, columns, rows, z_mm=thickness_mm)
    x_mm, y_mm = face.mean(axis=1)[:, :2].T
    is_trap = np.zeros(len(face), np.bool_)
    for middle_x_mm, middle_y_mm, side_mm in _TRAPS_MM:
        is_trap |= np.maximum(np.abs(x_mm - middle_x_mm), np.abs(y_mm - middle_y_mm)) < side_mm / 2.0
    white = np.concatenate([face[~is_trap], skirt(face)])
    return joined_surface(
        [of_material(white, appearance.MATT_WHITE), of_material(face[is_trap], appearance.BLACK_TRAP)]
    )


def chrome_ball(diameter_mm: float = 30.0, *, triangles: int = 80_000) -> Surface:
    """A mirror ball standing on z = 0."""
    return sphere(diameter_mm / 2, triangles=triangles, material=appearance.CHROME)


def sticker(diameter_mm: float = 6.0, *, border_mm: float = 10.0) -> Surface:
    """A scanner's target in z = 0, facing up: a retro-reflective disk on a black one of diameter `border_mm`.

    Creaform's have 6 mm and a border of 10 mm (assumed). Its centre is the origin.
    """
    if not 0.0 < diameter_mm < border_mm:
        raise InputError(
            f"sticker: expected a disk smaller than its border, found {diameter_mm} mm in {border_mm} mm; "
            "give diameters of both"
        )
    return joined_surface(
        [
            of_material(disk(diameter_mm / 2, _SEGMENTS), appearance.RETROREFLECTIVE),
            of_material(disk(border_mm / 2, _SEGMENTS, inner_mm=diameter_mm / 2), appearance.BLACK_PRINT),
        ]
    )


def stuck_on(surface: Surface, poses: Array, *, diameter_mm: float = 6.0) -> Surface:
    """The surface with a flat sticker at each of `poses` [n, 4, 4]."""
    sticker_surface = sticker(diameter_mm, border_mm=diameter_mm * _BORDER)
    return joined_surface([surface, *(moved_surface(sticker_surface, pose) for pose in poses)])


def sticker_poses(
    surface: Surface,
    count: int,
    seed: int = 1,
    *,
    diameter_mm: float = 6.0,
    gap_mm: float = 0.8,
    where: NDArray[np.bool_] | None = None,
) -> Array:
    """[count, 4, 4] object_from_sticker, mm: the origin is the sticker's centre, z points away from the surface.

    Places are drawn uniformly over the surface. A place is accepted if it faces up or sideways, if the surface
    under the border is within a layer of `gap_mm` and extends to the border on all sides, and if other stickers
    are at least half a border away. A sticker rests on the highest point under it. `where` [triangles] selects the
    triangles on which centres may lie.

    Raises:
        InputError: The surface has no room for `count` stickers.
    """
    from scipy.spatial import cKDTree

    radius_mm = 0.5 * _BORDER * diameter_mm
    random = np.random.default_rng(seed)
    area_mm2 = _areas_mm2(surface.corners_mm)
    # The surface is sampled by points, about forty under each sticker.
    size = int(np.clip(40.0 * area_mm2.sum() / radius_mm**2, 20_000, 2_000_000))
    triangle = random.choice(len(area_mm2), size, p=area_mm2 / area_mm2.sum())
    cloud_mm = _points_in(surface.corners_mm[triangle], random)
    normals = flat_normals(surface.corners_mm)[triangle]
    may_hold = normals[:, 2] > -0.1 if where is None else (normals[:, 2] > -0.1) & where[triangle]
    # Ridges may lie between the points: the triangles' corners are added.
    places_mm = np.concatenate([cloud_mm, surface.corners_mm.reshape(-1, 3)])
    facing = np.concatenate([normals, np.repeat(flat_normals(surface.corners_mm), 3, axis=0)])
    tree = cKDTree(places_mm)
    poses: list[Array] = []
    for place in np.flatnonzero(may_hold)[:_TRIES]:
        centre_mm = cloud_mm[place]
        if len(poses) == count:
            break
        if any(np.linalg.norm(pose[:3, 3] - centre_mm) < 3.0 * radius_mm for pose in poses):
            continue
        under = np.array(tree.query_ball_point(centre_mm, 1.05 * radius_mm))
        under = under[facing[under] @ normals[place] > -0.2]  # not the back of a plate
        normal = facing[under].mean(axis=0)
        normal /= np.linalg.norm(normal)
        around_mm = places_mm[under] - centre_mm
        height_mm = around_mm @ normal
        flat = np.ptp(height_mm) < gap_mm and (facing[under] @ normal).min() > 0.8
        if flat and _goes_on(around_mm, normal, radius_mm):
            poses.append(_standing(centre_mm + (height_mm.max() + _THICKNESS_MM) * normal, normal))
    if len(poses) < count:
        raise InputError(
            f"stickers: expected room for {count} of {diameter_mm} mm where the surface is flat to {gap_mm} mm; "
            f"found it for {len(poses)}; ask for fewer or smaller ones, or allow a wider gap"
        )
    return np.stack(poses) if poses else np.empty((0, 4, 4))


def _areas_mm2(corners_mm: Array) -> Array:
    cross = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    return np.asarray(0.5 * np.linalg.norm(cross, axis=1))


def _points_in(corners_mm: Array, random: np.random.Generator) -> Array:
    """One point [n, 3] in each triangle [n, 3, 3], evenly distributed."""
    u, v = random.random((2, len(corners_mm)))
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    points: Array = np.einsum("nk,nkj->nj", np.stack([1.0 - u - v, u, v], axis=1), corners_mm)
    return points


def _goes_on(around: Array, normal: Array, radius_mm: float) -> bool:
    """True if the surface extends to the border in all eight directions, so that no sticker overhangs an edge."""
    pose = _standing(np.zeros(3), normal)
    x, y = (around @ pose[:3, :2]).T
    outer = np.hypot(x, y) > 0.6 * radius_mm
    sectors = np.unique(((np.arctan2(y, x)[outer] / np.pi + 1.0) * 4.0).astype(int) % 8)
    return len(sectors) == 8


def _standing(centre_mm: Array, normal: Array) -> Array:
    """4x4 of a frame at `centre_mm` whose z is `normal`."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([x, np.cross(normal, x), normal, centre_mm], axis=1)
    return pose


def _tile(width_mm: float, depth_mm: float, thickness_mm: float, material: Material) -> Surface:
    """A slab whose face has cells of `_CELL_MM`, so that a falloff of light over it is resolved by triangles."""
    columns, rows = (max(1, round(length_mm / _CELL_MM)) for length_mm in (width_mm, depth_mm))
    face = rectangle(width_mm, depth_mm, columns, rows, z_mm=thickness_mm)
    return of_material(np.concatenate([face, skirt(face)]), material)

"""A measured surface in the form that programs of computer graphics need: a mesh with smooth normals, and maps of
its materials.

A normal map is written in the frame of the mesh. At each vertex this frame has the mean normal N of the triangles
around it, the tangent T along the map's columns, and N x T, which points up in the map. (For a chart that a given
texture has mirrored, T x N points up.) Within a triangle, N and T are interpolated and normalised. Programs that
compute tangents themselves, from a triangle's places in the map, find the same T on flat parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.atlas.atlas_layout import Atlas, MapSize, lay_out, lay_out_given, nearest_known
from coupole.exchange.atlas.charts import double_areas, unit
from coupole.exchange.atlas.open_sky import open_sky
from coupole.exchange.atlas.textured_mesh import TexturedMesh, read_textured_mesh
from coupole.exchange.material_values import UNCERTAIN, red_green_blue
from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.geometry import apply
from coupole.reflectance.fits import OF_TEXELS, TEXEL_CLUSTERS
from coupole.reflectance.run_result import VARIANCES
from coupole.reflectance.texels.gathered import Gathered, TexelView, gather, open_views
from coupole.reflectance.texels.texel_cluster_file import READ_TEXELS

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

MOST_SIDE_PX = 16384
_MOST_U, _MOST_U_OF_TRIANGLE, _MOST_U_OF_WHITE = 0.4, 0.15, 0.03
"""Limits of the standard uncertainty of kd. A material is known if it meets one of two limits. One limit is
relative to the material's kd: the first number for texels, the second for triangles, whose error may be in one
channel only. The other limit is relative to the kd of a white diffuser: the third number."""
_OF_MATERIAL = [n for n, name in enumerate(UNCERTAIN) if name != "u_normal"]
"""Columns of the uncertainties of a material. A shared material has none; normals are not shared."""
_BLOCK = 1 << 20
"""Number of texels that are looked up together."""


@dataclass(frozen=True)
class FlatMesh:
    """A mesh of v vertices, each of which belongs to one chart. Support frame, mm."""

    places_mm: Floats
    """[v, 3]"""
    normals: Floats
    """[v, 3] unit normals; the same for all vertices at one place."""
    tangents: Floats
    """[v, 3] unit, along the columns of the maps."""
    handedness: Floats
    """[v] 1, or -1 in mirrored charts: the factor by which N x T points up in the map."""
    map_places: Floats
    """[v, 2] places in the maps, 0 to 1, to the right and down from the top left corner."""
    triangles: NDArray[np.int64]
    """[m, 3]"""
    numbers: NDArray[np.int64]
    """[m] numbers of the triangles in the result's mesh."""
    open_sky: Floats
    """[v] share of the light of a uniform sky that reaches the vertex past the object."""


@dataclass(frozen=True)
class FlatSurface:
    """A mesh, and the materials of the k texels with a known material."""

    mesh: FlatMesh
    side_px: int
    texel_mm: float
    texel_of_place: NDArray[np.int32]
    """[side, side] the texel whose material a place of the maps has: within the padding the nearest one; -1 for
    none."""
    kd: Singles
    """[k, 3] 1/sr, red, green, blue."""
    ks: Singles
    """[k, 3]"""
    alpha: Singles
    """[k]"""
    normals: Singles
    """[k, 3] unit, support frame."""
    normals_in_frames: Singles
    """[k, 3] unit normals in the frames of the mesh: along the map's columns, up in the map, outwards."""
    uncertain: Singles
    """[k, 4] standard uncertainties from all sources: of kd and ks (relative), normal (rad), alpha (relative). NaN
    for materials that texels share."""
    numbers: NDArray[np.int64]
    """[k] triangles of the texels, in the result's mesh."""
    open_sky: Singles
    """[k]"""
    measured_share: float
    """Share of the texels on triangles that have a material from the pixels of a view; the others have the
    material of their triangle."""

    def map_of(self, values: NDArray[Any], nothing: Any = 0) -> NDArray[Any]:
        """[side, side, c] map of the values [k, c] of texels, with their type; `nothing` where there is no
        texel."""
        last = np.broadcast_to(np.asarray(nothing, values.dtype), (1, values.shape[1]))
        return np.asarray(np.concatenate([values, last])[self.texel_of_place])


def flatten(surface: MeasuredSurface) -> FlatSurface:
    """Lay a surface out in maps. The width of texels is that of the options. By default, it is the width of the
    texels in the finest view, or it follows from the allowed width of the map.

    Raises InputError if the maps would be wider than the options or `MOST_SIDE_PX` allow, or if nothing has a
    material.
    """
    textured_mesh = read_textured_mesh(surface.options.uv_mesh) if surface.options.uv_mesh else None
    views = open_views(surface.result, READ_TEXELS[surface.fit]) if surface.fit in OF_TEXELS else []
    rows = _rows_to_show(surface, views)
    surface.options.say("charts", 0, 1)
    rows, atlas = _lay_out(surface, rows, views, textured_mesh)
    surface.options.say("charts", 1, 1)
    return _fill(surface, rows, atlas, _Known(surface, views, rows, surface.vertices_mm[surface.triangles[rows]]))


def _lay_out(
    surface: MeasuredSurface, rows: NDArray[np.int64], views: list[TexelView], textured_mesh: TexturedMesh | None
) -> tuple[NDArray[np.int64], Atlas]:
    """Places of the triangles `rows`. With a mesh that has texture coordinates, only the triangles that both have
    are placed."""
    options = surface.options
    corners_mm = surface.vertices_mm[surface.triangles[rows]]
    texel_mm = options.texel_mm or _finest_mm(views, corners_mm)
    size = MapSize(texel_mm, options.map_px or MOST_SIDE_PX, may_be_coarser=options.texel_mm is None)
    if textured_mesh is None:
        return rows, lay_out(corners_mm, surface.triangles[rows], size)
    rows_there, places = textured_mesh.shared_with(corners_mm)
    if lost := len(rows) - len(rows_there):
        options.tell(
            f"{lost:,} of {len(rows):,} measured triangles are not in {textured_mesh.path.name}: left out"
        )
    triangles = surface.triangles[rows[rows_there]]
    return rows[rows_there], lay_out_given(places, corners_mm[rows_there], triangles, size)


def _rows_to_show(surface: MeasuredSurface, views: list[TexelView]) -> NDArray[np.int64]:
    """Triangles with a certain material, or with a certain texel at their middle or near a corner."""
    if not views:
        return np.flatnonzero(surface.has_material)
    is_shown = _has_certain_material(surface)
    rows = np.flatnonzero(~is_shown & np.isin(np.arange(len(is_shown)), surface.result.triangles))
    corners_mm = surface.vertices_mm[surface.triangles[rows]]
    middles_mm = corners_mm.mean(axis=1)
    for places_mm in (middles_mm, *(0.8 * corners_mm[:, n] + 0.2 * middles_mm for n in range(3))):
        _, is_certain = _seen_there(surface, views, places_mm)
        is_shown[rows[is_certain]] = True
    return np.flatnonzero(is_shown)


def _has_certain_material(surface: MeasuredSurface) -> NDArray[np.bool_]:
    return np.asarray(
        surface.has_material & _is_certain(surface.uncertain["u_kd"], surface.kd, _MOST_U_OF_TRIANGLE)
    )


def _is_certain(u_kd: NDArray[np.floating], kd: NDArray[np.floating], most_u: float) -> NDArray[np.bool_]:
    """[n] True if kd [n, channels], 1/sr, is certain, by its relative standard uncertainties [n]."""
    of_white = np.pi * u_kd * kd.mean(axis=1)
    return np.asarray((u_kd < most_u) | (of_white < _MOST_U_OF_WHITE))


def _seen_there(
    surface: MeasuredSurface, views: list[TexelView], places_mm: Floats
) -> tuple[Gathered, NDArray[np.bool_]]:
    """Materials that views show at places [k, 3] of the support frame, where they are certain. The normals of
    these materials are in the base frame. Shared materials are shown everywhere, as by `relight`: many texels tell
    them, so they are better known than a texel's own.
    """
    gathered_there = gather(views, apply(surface.result.base_from_support, places_mm))
    u_kd = np.sqrt(gathered_there.covariance[:, VARIANCES[2]])
    is_certain = (surface.fit == TEXEL_CLUSTERS) | _is_certain(u_kd, gathered_there.materials.kd, _MOST_U)
    return gathered_there, is_certain & (gathered_there.materials.alpha > 0.0)


def _finest_mm(views: list[TexelView], corners_mm: Floats) -> float:
    """Width of the texels of the finest view; for triangles, half the length of their edge."""
    if views:
        return min(view.texel_mm for view in views)
    return float(np.median(np.linalg.norm(corners_mm[:, 1] - corners_mm[:, 0], axis=1))) / 2.0


def _fill(surface: MeasuredSurface, rows: NDArray[np.int64], atlas: Atlas, known: _Known) -> FlatSurface:
    texels = np.flatnonzero(atlas.triangle_of_texel.reshape(-1) >= 0)
    values = _Values.empty(len(texels))
    for first in range(0, len(texels), _BLOCK):
        part = slice(first, min(first + _BLOCK, len(texels)))
        known.look_up(atlas, texels[part], values.rows(part))
        surface.options.say("texels", part.stop, len(texels))
    is_known = values.alpha > 0.0
    if not is_known.any():
        raise InputError(f"{surface.result.folder}: has no material to show")
    is_inside = atlas.is_inside.reshape(-1)[texels]
    measured_share = float(np.mean(values.is_measured[is_inside])) if is_inside.any() else 0.0
    mesh = _mesh(surface, rows, atlas, texels[is_known])
    texels, values = texels[is_known], values.rows(is_known)
    normals, sky = _in_frames(mesh, atlas, texels, values.normals)
    return FlatSurface(
        mesh.flat, atlas.side_px, atlas.texel_mm, _nearest(atlas, texels), values.kd, values.ks, values.alpha,
        values.normals, normals, values.uncertain, rows[atlas.triangle_of_texel.reshape(-1)[texels]], sky,
        measured_share,
    )  # fmt: skip


@dataclass(frozen=True)
class _Values:
    """Materials of texels; a roughness of 0 means that there is no material."""

    normals: Singles
    kd: Singles
    ks: Singles
    alpha: Singles
    uncertain: Singles
    is_measured: NDArray[np.bool_]

    @classmethod
    def empty(cls, count: int) -> _Values:
        normals, kd, ks = (np.zeros((count, 3), np.float32) for _ in range(3))
        alpha, uncertain = np.zeros(count, np.float32), np.zeros((count, 4), np.float32)
        return cls(normals, kd, ks, alpha, uncertain, np.zeros(count, np.bool_))

    def rows(self, part: slice | NDArray[np.bool_]) -> _Values:
        return _Values(*(values[part] for values in vars(self).values()))


class _Known:
    """Known materials of a surface's triangles `rows` [n], whose corners are `corners_mm` [n, 3, 3]."""

    def __init__(
        self, surface: MeasuredSurface, views: list[TexelView], rows: NDArray[np.int64], corners_mm: Floats
    ) -> None:
        self._surface, self._views, self._rows, self._corners_mm = surface, views, rows, corners_mm
        self._has_material = _has_certain_material(surface) if views else surface.has_material

    def look_up(self, atlas: Atlas, texels: NDArray[np.int64], values: _Values) -> None:
        """Fill the values of texels from the views' pixels. If a texel has no pixel, its triangle gives the
        values.
        """
        surface, triangle = self._surface, self._rows[atlas.triangle_of_texel.reshape(-1)[texels]]
        has_material = self._has_material[triangle]
        of_triangles = triangle[has_material]
        values.normals[has_material] = surface.normals[of_triangles]
        values.kd[has_material], values.ks[has_material] = surface.kd[of_triangles], surface.ks[of_triangles]
        values.alpha[has_material] = surface.alpha[of_triangles]
        for column, name in enumerate(UNCERTAIN):
            values.uncertain[has_material, column] = surface.uncertain[name][of_triangles]
        if self._views:
            self._look_up_views(atlas.places_mm(self._corners_mm, texels), values)

    def _look_up_views(self, places_mm: Floats, values: _Values) -> None:
        """Fill the certain values of views at places [k, 3]."""
        gathered_there, is_certain = _seen_there(self._surface, self._views, places_mm)
        materials = gathered_there.materials
        values.is_measured[:] = is_certain
        support_from_base = self._surface.result.base_from_support[:3, :3].T
        values.normals[is_certain] = materials.normals[is_certain] @ support_from_base.T
        values.kd[is_certain] = red_green_blue(materials.kd)[is_certain]
        values.ks[is_certain] = red_green_blue(materials.ks)[is_certain]
        values.alpha[is_certain] = materials.alpha[is_certain]
        first, second, kd, ks, alpha = gathered_there.covariance[is_certain][:, VARIANCES].T
        common = np.mean([view.u_common**2 for view in self._views])
        columns = (np.sqrt(kd + common), np.sqrt(ks + common), np.sqrt(first + second), np.sqrt(alpha))
        uncertain = np.stack(columns, axis=1)
        if self._surface.fit == TEXEL_CLUSTERS:
            uncertain[:, _OF_MATERIAL] = np.nan
        values.uncertain[is_certain] = uncertain


@dataclass(frozen=True)
class _Mesh:
    """A flat mesh, and its vertices for the corners of all triangles of the atlas."""

    flat: FlatMesh
    corners: NDArray[np.int64]
    """[n, 3] vertices of the corners."""


def _mesh(
    surface: MeasuredSurface, rows: NDArray[np.int64], atlas: Atlas, known_texels: NDArray[np.int64]
) -> _Mesh:
    """Build the mesh, without triangles that have no known texel."""
    triangles = surface.triangles[rows]
    keys = triangles * (int(atlas.chart.max()) + 1) + atlas.chart[:, None]
    _, first, number = np.unique(keys, return_index=True, return_inverse=True)
    corners = number.reshape(-1, 3)
    vertices = triangles.reshape(-1)[first]
    normals = _vertex_normals(surface)[vertices]
    map_places = atlas.corners_px.reshape(-1, 2)[first] / atlas.side_px
    tangents = _tangents(surface.vertices_mm[triangles], atlas.corners_px, corners, normals)
    is_shown = np.zeros(len(rows), np.bool_)
    is_shown[atlas.triangle_of_texel.reshape(-1)[known_texels]] = True
    places_mm, handedness = surface.vertices_mm[vertices], np.repeat(atlas.handedness, 3)[first]
    sky = open_sky(surface.vertices_mm[surface.triangles], places_mm, normals)
    flat = FlatMesh(places_mm, normals, tangents, handedness, map_places, corners[is_shown], rows[is_shown], sky)
    return _Mesh(flat, corners)


def _vertex_normals(surface: MeasuredSurface) -> Floats:
    """[vertices, 3] means of the normals of the triangles around, weighted by area."""
    areas = double_areas(surface.vertices_mm[surface.triangles])
    count = len(surface.vertices_mm)
    sums = [np.bincount(surface.triangles.reshape(-1), np.repeat(column, 3), count) for column in areas.T]
    return unit(np.stack(sums, axis=1))


def _tangents(corners_mm: Floats, corners_px: Floats, corners: NDArray[np.int64], normals: Floats) -> Floats:
    """[v, 3] tangents: the mean, over a vertex's triangles, of the direction along the map's columns,
    perpendicular to the vertex's normal."""
    ab_mm, ac_mm = corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0]
    ab_px, ac_px = corners_px[:, 1] - corners_px[:, 0], corners_px[:, 2] - corners_px[:, 0]
    turn = np.sign(ab_px[:, 0] * ac_px[:, 1] - ab_px[:, 1] * ac_px[:, 0])
    ways = unit(turn[:, None] * (ab_mm * ac_px[:, 1:] - ac_mm * ab_px[:, 1:]))
    sums = [np.bincount(corners.reshape(-1), np.repeat(column, 3), len(normals)) for column in ways.T]
    means = np.stack(sums, axis=1)
    across = means - np.einsum("vk,vk->v", means, normals)[:, None] * normals
    is_lost = np.linalg.norm(across, axis=1) < 1e-6
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across[is_lost] = np.cross(normals, helper)[is_lost]
    return unit(across)


def _in_frames(mesh: _Mesh, atlas: Atlas, texels: NDArray[np.int64], normals: Singles) -> tuple[Singles, Singles]:
    """Normals of texels in the frames of the mesh, turned to its outer side, and the open sky of the texels."""
    local = np.empty_like(normals)
    sky = np.empty(len(texels), np.float32)
    for first in range(0, len(texels), _BLOCK):
        part = slice(first, first + _BLOCK)
        weights = np.clip(atlas.barycentric(texels[part]), 0.0, 1.0)
        weights /= weights.sum(axis=1, keepdims=True)
        corners = mesh.corners[atlas.triangle_of_texel.reshape(-1)[texels[part]]]
        outward = unit(np.einsum("kc,kcx->kx", weights, mesh.flat.normals[corners]))
        along = unit(np.einsum("kc,kcx->kx", weights, mesh.flat.tangents[corners]))
        up = np.cross(outward, along) * mesh.flat.handedness[corners[:, :1]]
        frames = np.stack([along, up, outward], axis=2)
        components = np.linalg.solve(frames, normals[part].astype(np.float64)[..., None])[..., 0]
        components[:, 2] = np.maximum(components[:, 2], 0.0)
        local[part] = unit(components)
        sky[part] = np.einsum("kc,kc->k", weights, mesh.flat.open_sky[corners])
    return local, sky


def _nearest(atlas: Atlas, known_texels: NDArray[np.int64]) -> NDArray[np.int32]:
    """[side, side] the nearest known texel, for all texels on triangles or in padding; -1 elsewhere."""
    number = np.full(atlas.side_px**2, -1, np.int32)
    number[known_texels] = np.arange(len(known_texels), dtype=np.int32)
    picture = number.reshape(atlas.side_px, atlas.side_px)
    nearest, _ = nearest_known(picture)
    return np.where(atlas.triangle_of_texel >= 0, nearest, -1).astype(np.int32)

"""A mesh with its own texture coordinates, such as a museum's model, matched to the triangles of a result.

Modelling programs write the same mesh in other units, rotated, and with its triangles in another order. So a
triangle is identified by the ratios of its edges, which are rarely the same for two triangles of a scan. Triangles
with unique ratios give the similarity transform (Umeyama 1991, "Least-squares estimation of transformation
parameters between two point patterns") from the file to the support frame. There, triangles are the same if their
corners coincide.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from coupole.errors import InputError, reason

Floats = NDArray[np.float64]

SUFFIXES = (".obj", ".ply", ".glb", ".gltf")
_OFF, _OFF_OF_SIZE = 1e-2, 3e-6
"""Greatest distance between corners that count as the same, as a share of the median edge and of the object's
size. Files have six digits, or single precision."""
_NEAR = 0.1
"""Greatest distance between the middles of triangles that may be the same, before corners are compared. It is also
the greatest ratio of the distances to the best and to the second-best match."""
_LEAST_ALONE, _MOST_ALONE = 16, 4000
_ROUNDS = 8
_LEAST_SHARE = 0.5
"""Least share of the result's triangles that the file must have."""


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles of a mesh file, and their places in its texture."""

    path: Path
    corners: Floats
    """[m, 3, 3] corners in the file's units and frame."""
    places: Floats
    """[m, 3, 2] 0 to 1, to the right and down from the texture's top left corner."""

    def shared_with(self, corners_mm: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Return the rows of triangles [n, 3, 3] that the file has, and their corners' places [k, 3, 2].

        Raises InputError if the file has fewer than half of them.
        """
        edge_mm = float(np.median(np.linalg.norm(np.roll(corners_mm, -1, axis=1) - corners_mm, axis=2)))
        best = np.empty(0, np.int64), np.empty((0, 3, 2))
        for similarity in (self._by_order(corners_mm), self._by_shape(corners_mm, edge_mm)):
            if similarity is None:
                continue
            rows, places = self._same(corners_mm, similarity, edge_mm)
            if len(rows) > len(best[0]):
                best = rows, places
            if len(rows) == len(corners_mm):
                break
        if len(best[0]) < _LEAST_SHARE * len(corners_mm):
            raise InputError(
                f"--uv {self.path}: has {len(best[0]):,} of the result's {len(corners_mm):,} triangles; expected "
                "the mesh that the result was made of, with the same triangles (unit, place and order may differ)"
            )
        return best

    def _by_order(self, corners_mm: Floats) -> tuple[float, Floats, Floats] | None:
        """The similarity transform if triangles have the same order."""
        if len(self.corners) != len(corners_mm):
            return None
        return _similarity(self.corners.reshape(-1, 3), corners_mm.reshape(-1, 3))

    def _by_shape(self, corners_mm: Floats, edge_mm: float) -> tuple[float, Floats, Floats] | None:
        """The similarity transform from triangles with a unique shape."""
        file_ratios, first_in_file = _ratios(self.corners)
        result_ratios, first_in_result = _ratios(corners_mm)
        if len(file_ratios) < _LEAST_ALONE:
            return None
        distance, number = KDTree(file_ratios).query(result_ratios, k=2)
        rows = np.flatnonzero(distance[:, 0] < _NEAR * distance[:, 1])
        rows = rows[np.argsort(-distance[rows, 1])[:_MOST_ALONE]]
        if len(rows) < _LEAST_ALONE:
            return None
        places_mm = _from_first(corners_mm, first_in_result)[rows].reshape(-1, 3)
        points = _from_first(self.corners, first_in_file)[number[rows, 0]].reshape(-1, 3)
        similarity = _similarity(points, places_mm)
        for _ in range(_ROUNDS):  # some triangles resemble each other by chance
            off_mm = np.linalg.norm(_apply(points, similarity) - places_mm, axis=1)
            is_near = off_mm <= max(float(np.median(off_mm)), _OFF * edge_mm)
            similarity = _similarity(points[is_near], places_mm[is_near])
        return similarity

    def _same(
        self, corners_mm: Floats, similarity: tuple[float, Floats, Floats], edge_mm: float
    ) -> tuple[NDArray[np.int64], Floats]:
        file_corners_mm = _apply(self.corners.reshape(-1, 3), similarity).reshape(-1, 3, 3)
        distance_mm, number = KDTree(file_corners_mm.mean(axis=1)).query(corners_mm.mean(axis=1))
        rows = np.flatnonzero(distance_mm <= _NEAR * edge_mm)
        candidates_mm, places = file_corners_mm[number[rows]], self.places[number[rows]]
        best_off_mm, best_places = np.full(len(rows), np.inf), places
        for turn in range(3):  # the same triangle may begin at another corner
            off_mm = np.linalg.norm(np.roll(candidates_mm, turn, axis=1) - corners_mm[rows], axis=2).max(axis=1)
            is_better = off_mm < best_off_mm
            best_off_mm = np.where(is_better, off_mm, best_off_mm)
            best_places = np.where(is_better[:, None, None], np.roll(places, turn, axis=1), best_places)
        is_same = best_off_mm <= _limit_mm(corners_mm, edge_mm)
        return rows[is_same], best_places[is_same]


def read_textured_mesh(path: Path) -> TexturedMesh:
    """Read the triangles and texture coordinates of an OBJ, PLY or glTF.

    Raises InputError if the file is none of these, has no texture coordinates, or has some outside the texture.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"--uv {path}: expected a mesh with the ending {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"--uv {path}: expected a mesh file; there is no such file")
    parts = _parts(path)
    if not parts:
        raise InputError(f"--uv {path}: has no triangles")
    if any(uv is None for _, uv in parts):
        raise InputError(f"--uv {path}: has no texture coordinates (`vt` of an OBJ); unwrap the mesh first")
    corners, uv = np.concatenate([corners for corners, _ in parts]), np.concatenate([uv for _, uv in parts])
    if not np.isfinite(uv).all() or not np.isfinite(corners).all():
        raise InputError(f"--uv {path}: has coordinates that are not numbers")
    is_outside = ((uv < -1e-6) | (uv > 1.0 + 1e-6)).any(axis=(1, 2))
    if is_outside.any():
        raise InputError(
            f"--uv {path}: {is_outside.sum():,} of {len(uv):,} triangles lie outside the texture (0 to 1): "
            "several textures (UDIM) and repeated ones cannot be used"
        )
    return TexturedMesh(path, corners, np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=2))


def _parts(path: Path) -> list[tuple[Floats, Any]]:
    """Corners [m, 3, 3] of each mesh of the file, placed as in its scene, and their u and v [m, 3, 2], with v
    upwards; None if the mesh has no texture coordinates."""
    import trimesh

    parts = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of vertices that belong to no triangle
            scene = trimesh.load_scene(path, process=False)
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if len(faces := np.asarray(getattr(mesh, "faces", ()))):
                vertices = np.asarray(mesh.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
                uv = getattr(mesh.visual, "uv", None)
                has_uv = uv is not None and len(uv) > 0
                parts.append((vertices[faces], np.asarray(uv, np.float64)[faces] if has_uv else None))
    except Exception as error:  # trimesh's readers raise many kinds of errors for bad files
        raise InputError(f"--uv {path}: cannot be read: {reason(error) or type(error).__name__}") from error
    return parts


def _ratios(corners: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """[n, 2] ratios of the second and third edge of triangles [n, 3, 3] to the longest edge, and the corner where
    the longest edge begins."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    first = np.argmax(lengths, axis=1)
    ratios = np.take_along_axis(lengths, (first[:, None] + np.arange(3)) % 3, axis=1)
    return ratios[:, 1:] / np.maximum(ratios[:, :1], 1e-300), first


def _from_first(corners: Floats, first: NDArray[np.int64]) -> Floats:
    return np.take_along_axis(corners, ((first[:, None] + np.arange(3)) % 3)[..., None], axis=1)


def _similarity(points: Floats, places: Floats) -> tuple[float, Floats, Floats]:
    """Scale, rotation and translation that map points [n, 3] to places [n, 3] (Umeyama 1991, eqs. 40 to 43)."""
    centre, aim = points.mean(axis=0), places.mean(axis=0)
    u, singular, v_transposed = np.linalg.svd((places - aim).T @ (points - centre) / len(points))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v_transposed)) or 1.0])
    rotation = u @ np.diag(signs) @ v_transposed
    scale = float(singular @ signs / max(float(np.mean(np.sum((points - centre) ** 2, axis=1))), 1e-300))
    return scale, rotation, aim - scale * rotation @ centre


def _apply(points: Floats, similarity: tuple[float, Floats, Floats]) -> Floats:
    scale, rotation, shift = similarity
    return np.asarray(scale * points @ rotation.T + shift)


def _limit_mm(corners_mm: Floats, edge_mm: float) -> float:
    size_mm = float(np.ptp(corners_mm.reshape(-1, 3), axis=0).max())
    return max(_OFF * edge_mm, _OFF_OF_SIZE * size_mm)

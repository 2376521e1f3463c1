"""The object's surface as the pixels of a picture see it: from a measured view, or from a camera anywhere.

A result keeps, for each view, where the camera stood and which triangle each pixel sees, but not its lens. The
directions of the pixels follow from that: triangles' centres are seen in known directions, and a polynomial of the
pixel through some thousand of them has the lens and its distortion in it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import h5py
import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.run_result import RunResult, ViewSamples

Floats = NDArray[np.float64]

_DEGREE = 5
"""Degree of the polynomial: for Brown's k2, and a homography up to 1e-6."""
_LEAST_TRIANGLES = 4 * (_DEGREE + 1) * (_DEGREE + 2) // 2
_OUTLIER = 4.0
"""Largest departure of a triangle, over the median departure: beyond it are triangles that are seen in part."""
_MARGIN = 1.05
"""Factor for a margin about the object, in a picture whose field of view is not given."""


@dataclass(frozen=True)
class Surface:
    """Surface that the pixels of a picture [h, w] see."""

    triangle_of_pixel: NDArray[np.int32]
    """[h, w] place in `triangles`; -1 for none."""
    places_mm: NDArray[np.float32]
    """[h, w, 3] base frame."""
    camera_mm: Floats
    """[3]"""
    triangles: NDArray[np.int64]
    """Rising numbers in the mesh."""
    centres_mm: Floats
    """[triangles, 3]"""
    normals: Floats
    """[triangles, 3] of the mesh."""

    @cached_property
    def offsets_mm(self) -> Floats:
        """[triangles] of their planes from the origin, along the normals."""
        offsets: Floats = np.einsum("tk,tk->t", self.centres_mm, self.normals)
        return offsets


@dataclass(frozen=True)
class FreeCamera:
    """A pinhole camera anywhere, in the support frame; z is up in the picture, y if it looks along z."""

    at_mm: Floats
    look_at_mm: Floats | None = None
    """The middle of the object without it."""
    size_px: tuple[int, int] = (1024, 768)
    """Width, height."""
    field_of_view_deg: float | None = None
    """Across the width; as narrow as the object allows without it."""


def surface_of_view(result: RunResult, view: ViewSamples) -> Surface:
    """Return the surface of a measured view; a mesh of fewer than some hundred seen triangles is seen at the
    triangles' centres."""
    with h5py.File(view.path, "r") as file:
        triangle_of_pixel, centres_mm, normals = file["seen"][()], file["centres_mm"][()], file["normals"][()]
    places_mm = np.full((*triangle_of_pixel.shape, 3), np.nan, np.float32)
    polynomial = _directions(triangle_of_pixel, centres_mm, view.camera_mm)
    if polynomial is None:
        places_mm[triangle_of_pixel >= 0] = centres_mm[triangle_of_pixel[triangle_of_pixel >= 0]]
    else:
        geometry = *polynomial, view.camera_mm, centres_mm, normals
        in_strips(
            len(triangle_of_pixel),
            lambda rows: _meet(rows.start, triangle_of_pixel[rows], *geometry, places_mm[rows]),
        )
    return Surface(triangle_of_pixel, places_mm, view.camera_mm, view.triangles, centres_mm, normals)


def surface_from(result: RunResult, mesh: PacketMesh, camera: FreeCamera) -> Surface:
    """Return the surface of the triangles that any view has seen, from a camera anywhere. Those of `mesh` that no
    view has seen hide what is behind them, as others do. Raises InputError if the camera sees none."""
    triangles = result.triangles
    corners_mm = result.corners_mm[triangles].astype(np.float64)
    normals = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    places = np.full(len(result.corners_mm), -1, np.int32)
    places[triangles] = np.arange(len(triangles))
    base_from_camera, focal_px = _aim_camera(result, camera)
    width, height = camera.size_px
    camera_mm = base_from_camera[:3, 3]
    triangle_of_pixel = np.full((height, width), -1, np.int32)
    places_mm = np.full((height, width, 3), np.nan, np.float32)

    def trace(rows: slice) -> None:
        y, x = np.mgrid[rows, 0:width]
        local = [(x - (width - 1) / 2) / focal_px, (y - (height - 1) / 2) / focal_px, np.ones(x.shape)]
        ways = np.stack(local, axis=-1) @ base_from_camera[:3, :3].T
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        hits = mesh.first_met(camera_mm, ways.reshape(-1, 3).astype(np.float32))
        number, distance = (hit.reshape(x.shape) for hit in hits)
        here = np.where(number >= 0, places[number], -1)
        here[np.einsum("hwk,hwk->hw", normals[here], ways) >= 0.0] = -1
        triangle_of_pixel[rows] = here
        places_mm[rows] = np.where((here >= 0)[..., None], camera_mm + distance[..., None] * ways, np.nan)

    in_strips(height, trace)
    if not (triangle_of_pixel >= 0).any():
        raise InputError("--from: no pixel of this camera sees a measured part of the object; look at it")
    return Surface(triangle_of_pixel, places_mm, camera_mm, triangles, corners_mm.mean(axis=1), normals)


def in_strips(height: int, work: Callable[[slice], None]) -> None:
    """Do something for all rows of a picture, in parallel."""
    threads = len(os.sched_getaffinity(0))
    step = max(1, math.ceil(height / (8 * threads)))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, [slice(first, min(first + step, height)) for first in range(0, height, step)]))


def _aim_camera(result: RunResult, camera: FreeCamera) -> tuple[Floats, float]:
    """base_from_camera [4, 4] (z forward, x right, y down), and the focal length in px."""
    points_mm = result.corners_mm[result.triangles].reshape(-1, 3).astype(np.float64)
    at_mm = apply(result.base_from_support, camera.at_mm)
    target_mm = 0.5 * (points_mm.min(axis=0) + points_mm.max(axis=0))
    if camera.look_at_mm is not None:
        target_mm = apply(result.base_from_support, camera.look_at_mm)
    forward = target_mm - at_mm
    distance_mm = float(np.linalg.norm(forward))
    if distance_mm < 1e-6:
        raise InputError("--look-at: expected another place than --from")
    forward /= distance_mm
    up = result.base_from_support[:3, 2]
    if np.linalg.norm(np.cross(forward, up)) < 1e-6:
        up = result.base_from_support[:3, 1]
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    base_from_camera = np.eye(4)
    base_from_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    base_from_camera[:3, 3] = at_mm
    width, height = camera.size_px
    if camera.field_of_view_deg is not None:
        return base_from_camera, 0.5 * width / math.tan(math.radians(camera.field_of_view_deg) / 2)
    local = (points_mm - at_mm) @ base_from_camera[:3, :3]
    if local[:, 2].min() < 1e-3 * distance_mm:
        raise InputError("--from: the object is beside or behind this camera too; give --field-of-view")
    reach = np.abs(local[:, :2] / local[:, 2:]).max(axis=0) * _MARGIN
    return base_from_camera, 0.5 * float(np.min(np.array([width, height]) / reach))


def _directions(
    triangle_of_pixel: NDArray[np.int32], centres_mm: Floats, camera_mm: Floats
) -> tuple[Floats, Floats, Floats] | None:
    """Return what turns a pixel into its direction: [3] middle column and row and the scale of both, [6, 6, 2]
    coefficients of column^i row^j, [3, 3] rows: axes of the directions' frame, the last forward. None for too few
    triangles."""
    row, column = np.nonzero(triangle_of_pixel >= 0)
    triangle = triangle_of_pixel[row, column]
    count = np.bincount(triangle, minlength=len(centres_mm)).astype(np.float64)
    if np.count_nonzero(count) < _LEAST_TRIANGLES:
        return None
    in_view = count > 0
    sums = [np.bincount(triangle, axis, len(count))[in_view] for axis in (column, row)]
    pixels = np.stack(sums, axis=1) / count[in_view, None]
    ways = centres_mm[in_view] - camera_mm
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    forward = ways.mean(axis=0) / np.linalg.norm(ways.mean(axis=0))
    right = np.cross([0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0], forward)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(forward, right), forward])
    local = ways @ frame.T
    tangents = local[:, :2] / local[:, 2:]
    middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
    scale = np.maximum(0.5 * float(np.ptp(pixels, axis=0).max()), 1.0)
    x, y = ((pixels - middle) / scale).T
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    design = np.stack([x**i * y**j for i, j in powers], axis=1)
    weight = np.sqrt(count[in_view])
    for _ in range(2):
        fitted_coefficients = np.linalg.lstsq(design * weight[:, None], tangents * weight[:, None], rcond=None)[0]
        off = np.linalg.norm(design @ fitted_coefficients - tangents, axis=1)
        weight = np.where(off <= _OUTLIER * np.median(off), np.sqrt(count[in_view]), 0.0)
    coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1, 2))
    for (i, j), pair in zip(powers, fitted_coefficients, strict=True):
        coefficients[i, j] = pair
    return np.append(middle, scale), coefficients, frame


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _meet(  # type: ignore[no-untyped-def]
    first_row, triangle_of_pixel, pixel_scale, coefficients, frame, camera_mm, centres_mm, normals, places_mm
):
    """Fill `places_mm` with the places where the rays of rows of pixels meet the planes of the triangles that they
    see."""
    order = len(coefficients)
    along = np.empty((order, 2))
    way = np.empty(3)
    for row in range(triangle_of_pixel.shape[0]):
        y = (first_row + row - pixel_scale[1]) / pixel_scale[2]
        for i in range(order):
            for k in range(2):
                total = 0.0
                for j in range(order - 1 - i, -1, -1):
                    total = total * y + coefficients[i, j, k]
                along[i, k] = total
        for column in range(triangle_of_pixel.shape[1]):
            triangle = triangle_of_pixel[row, column]
            if triangle < 0:
                continue
            x = (column - pixel_scale[0]) / pixel_scale[2]
            u, v = 0.0, 0.0
            for i in range(order - 1, -1, -1):
                u, v = u * x + along[i, 0], v * x + along[i, 1]
            above, slope = 0.0, 0.0
            for k in range(3):
                way[k] = u * frame[0, k] + v * frame[1, k] + frame[2, k]
                above += normals[triangle, k] * (centres_mm[triangle, k] - camera_mm[k])
                slope += normals[triangle, k] * way[k]
            for k in range(3):
                places_mm[row, column, k] = camera_mm[k] + above / slope * way[k]

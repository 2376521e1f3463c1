"""The object's surface as the pixels of a picture see it, from a measured view or from a camera at any place.

For each view, a result keeps the camera's place and the triangle that each pixel sees, but not the lens. The
directions of the pixels follow from these: triangles' centres are seen in known directions. A polynomial of the
pixel, fitted to some thousand of them, includes the lens and its distortion.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
from numpy.polynomial.polynomial import polyval2d
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.kernels import kernel
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.parts_in_threads import first_alone
from coupole.reflectance.run_result import RunResult, ViewSamples

Floats = NDArray[np.float64]

_DEGREE = 5
"""Degree of the polynomial: enough for Brown's k2, and for a homography up to 1e-6."""
_LEAST_TRIANGLES = 4 * (_DEGREE + 1) * (_DEGREE + 2) // 2
_OUTLIER = 4.0
"""Largest deviation of a triangle that is used, relative to the median deviation. Triangles with a larger
deviation are only partly visible."""
_MARGIN = 1.05
"""Factor that leaves a margin around the object in a picture without a given field of view."""


@dataclass(frozen=True)
class Surface:
    """The surface that the pixels of a picture [h, w] see."""

    triangle_of_pixel: NDArray[np.int32]
    """[h, w] place in `triangles`; -1 for no triangle."""
    places_mm: NDArray[np.float32]
    """[h, w, 3] base frame."""
    camera_mm: Floats
    """[3]"""
    triangles: NDArray[np.int64]
    """Numbers in the mesh, in rising order."""
    centres_mm: Floats
    """[triangles, 3]"""
    normals: Floats
    """[triangles, 3] normals of the mesh."""

    @cached_property
    def offsets_mm(self) -> Floats:
        """[triangles] distances of their planes from the origin, along the normals."""
        offsets: Floats = np.einsum("tk,tk->t", self.centres_mm, self.normals)
        return offsets

    def by_texels(self, texel_of_pixel: NDArray[np.int32]) -> Surface:
        """Return the same surface for shading by texels: the numbers of texels [h, w], -1 for none, replace those
        of triangles."""
        seen = texel_of_pixel >= 0
        triangle = np.zeros(int(texel_of_pixel.max(initial=-1)) + 1, np.int64)
        triangle[texel_of_pixel[seen]] = self.triangle_of_pixel[seen]
        return Surface(
            texel_of_pixel,
            self.places_mm,
            self.camera_mm,
            self.triangles[triangle],
            self.centres_mm[triangle],
            self.normals[triangle],
        )


@dataclass(frozen=True)
class FreeCamera:
    """A pinhole camera at any place, in the support frame. In the picture z is up, or y if the camera looks along
    z."""

    at_mm: Floats
    """[3] its projection centre."""
    look_at_mm: Floats | None = None
    """Point at which the camera looks; the middle of the object by default."""
    size_px: tuple[int, int] = (1024, 768)
    """Width, height."""
    field_of_view_deg: float | None = None
    """Field of view across the width; by default as narrow as the object allows."""


def surface_of_view(result: RunResult, view: ViewSamples) -> Surface:
    """Return the surface of a measured view. If the view sees too few triangles to find the directions of its
    pixels, the triangles' centres are used as the places of the pixels."""
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
    """Return the surface of the triangles that any view has seen, from a camera at any place. Triangles of `mesh`
    that no view has seen also hide the surface behind them. Raises InputError if the camera sees no triangle.
    """
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
        raise InputError(
            "--from: no pixel of this camera sees a measured part of the object; turn the camera to the object"
        )
    return Surface(triangle_of_pixel, places_mm, camera_mm, triangles, corners_mm.mean(axis=1), normals)


def in_strips(height: int, work: Callable[[slice], None]) -> None:
    """Call a function for all rows of a picture, in parallel."""
    threads = len(os.sched_getaffinity(0))
    step = max(1, math.ceil(height / (8 * threads)))
    with ThreadPoolExecutor(threads) as pool:
        strips = [slice(first, min(first + step, height)) for first in range(0, height, step)]
        list(pool.map(first_alone(work), strips))


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


@dataclass(frozen=True)
class _Centres:
    """Triangles' centres as they appear in a picture."""

    pixels: Floats
    """[n, 2] column and row: means of the pixels that see a triangle."""
    tangents: Floats
    """[n, 2] tangents of their directions, in `frame`."""
    weights: Floats
    """[n] square roots of the numbers of pixels."""
    frame: Floats
    """[3, 3] rows: axes of the directions' frame, the last one forward."""


def _seen_centres(triangle_of_pixel: NDArray[np.int32], centres_mm: Floats, camera_mm: Floats) -> _Centres | None:
    """Return the centres that appear in a picture; None for too few."""
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
    return _Centres(pixels, local[:, :2] / local[:, 2:], np.sqrt(count[in_view]), frame)


def _directions(
    triangle_of_pixel: NDArray[np.int32], centres_mm: Floats, camera_mm: Floats
) -> tuple[Floats, Floats, Floats] | None:
    """Return three arrays that convert a pixel to its direction. The first, [3], has the middle column, the middle
    row and the scale of both. The second, [6, 6, 2], has the coefficients of column^i row^j. The rows of the
    third, [3, 3], are the axes of the frame of directions; the last axis points forward. Returns None if there are
    too few triangles."""
    centres = _seen_centres(triangle_of_pixel, centres_mm, camera_mm)
    if centres is None:
        return None
    return *_polynomial(centres.pixels, centres.tangents, centres.weights), centres.frame


def pixels_of_places(surface: Surface, places_mm: NDArray[np.floating]) -> Floats | None:
    """[n, 2] column and row of places [n, 3] in a measured view, even if they are hidden; NaN behind the camera.
    None if the view shows too few triangles."""
    centres = _seen_centres(surface.triangle_of_pixel, surface.centres_mm, surface.camera_mm)
    if centres is None:
        return None
    scale, coefficients = _polynomial(centres.tangents, centres.pixels, centres.weights)
    local = (places_mm - surface.camera_mm) @ centres.frame.T
    ahead = local[:, 2:] > 0.0
    tangents = np.where(ahead, local[:, :2] / np.where(ahead, local[:, 2:], 1.0), np.nan)
    x, y = ((tangents - scale[:2]) / scale[2]).T
    pixels: Floats = polyval2d(x, y, coefficients).T
    return pixels


def _polynomial(given: Floats, wanted: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Fit `wanted` [n, 2] with polynomials in `given` [n, 2]. Return the middle and scale of `given` [3], and the
    coefficients [6, 6, 2] of x^i y^j. Triangles that are only partly visible are left out."""
    middle = 0.5 * (given.min(axis=0) + given.max(axis=0))
    scale = max(0.5 * float(np.ptp(given, axis=0).max()), 1e-9)
    x, y = ((given - middle) / scale).T
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    design = np.stack([x**i * y**j for i, j in powers], axis=1)
    weight = weights
    for _ in range(2):
        fitted_coefficients = np.linalg.lstsq(design * weight[:, None], wanted * weight[:, None], rcond=None)[0]
        off = np.linalg.norm(design @ fitted_coefficients - wanted, axis=1)
        weight = np.where(off <= _OUTLIER * np.median(off), weights, 0.0)
    coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1, 2))
    for (i, j), pair in zip(powers, fitted_coefficients, strict=True):
        coefficients[i, j] = pair
    return np.append(middle, scale), coefficients


@kernel(error_model="numpy")
def _meet(  # type: ignore[no-untyped-def]
    first_row, triangle_of_pixel, pixel_scale, coefficients, frame, camera_mm, centres_mm, normals, places_mm
):
    """Fill `places_mm` with the places where the rays of some rows of pixels meet the planes of the triangles that
    they see."""
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

"""What the simulated camera sees: a mesh on the support, lit by one LED or panel at a time.

Geometry is exact (pinhole projection, z-buffer, the world's true camera pose), shading is simple: Lambert
with one flat normal per triangle, point emitters with a cosine lobe, no cast shadows. Everything is in the
robot's base frame, in mm; fluxes in lm, irradiances in lux.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, apply, inverse

OBJECT_ALBEDO = (0.62, 0.55, 0.42)
"""Red, green, blue reflectance of the object: warm stone (assumed)."""
SUPPORT_ALBEDO = (0.04, 0.04, 0.045)
"""Black anodised Dibond (facts/instrument: 'more absorbing'; the value is assumed)."""
_UNIT_MM = {"mm": 1.0, "m": 1000.0, "um": 1e-3}
_SUPPORT_SEGMENTS = 96
_NEAR_MM = 1.0


@dataclass(frozen=True)
class Leds:
    """The LED table: positions [n, 3] and normals [n, 3] in the base frame, flux [n] in lm."""

    ids: NDArray[np.int64]
    boards: NDArray[np.int64]
    positions_mm: NDArray[np.float64]
    normals: NDArray[np.float64]
    flux_lm: NDArray[np.float64]


def read_leds(path: Path) -> Leds:
    """LEDs of a dome's CSV: id, board, x_mm, y_mm, z_mm, nx, ny, nz, flux_lm; `#` starts a comment."""
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    table = np.array([[float(v) for v in line.split(",")] for line in lines[1:]])
    return Leds(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:5], table[:, 5:8], table[:, 8])


@dataclass(frozen=True)
class Scene:
    """Triangles in the base frame with their normals and albedos."""

    corners_mm: NDArray[np.float32]
    """[triangles, 3, 3]."""
    centroids_mm: NDArray[np.float64]
    normals: NDArray[np.float64]
    albedo: NDArray[np.float64]
    """[triangles, 3], red green blue."""


def load_mesh(path: Path, unit: str) -> NDArray[np.float64]:
    """Corners [triangles, 3, 3] in mm of any mesh that trimesh reads."""
    import trimesh

    mesh: Any = trimesh.load(path, process=False, force="mesh")
    corners: NDArray[np.float64] = np.asarray(mesh.vertices)[np.asarray(mesh.faces)] * _UNIT_MM[unit]
    return corners


def build_scene(
    base_from_support: Transform, support_diameter_mm: float, objects_support: list[NDArray[np.float64]]
) -> Scene:
    """Scene of the support disk and of objects, given as corners [n, 3, 3] in the support frame."""
    angle = np.linspace(0.0, 2 * np.pi, _SUPPORT_SEGMENTS + 1)
    rim = 0.5 * support_diameter_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    disk = np.stack([np.zeros_like(rim[:-1]), rim[:-1], rim[1:]], axis=1)
    corners = apply(base_from_support, np.concatenate([disk, *objects_support]))
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    albedo = np.empty((len(corners), 3))
    albedo[: len(disk)] = SUPPORT_ALBEDO
    albedo[len(disk) :] = OBJECT_ALBEDO
    normals = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    return Scene(corners.astype(np.float32), corners.mean(axis=1), normals, albedo)


@dataclass(frozen=True)
class Pinhole:
    """The simulated camera's optics: focal length in pixels, principal point at the image's centre."""

    width_px: int
    height_px: int
    focal_px: float

    @staticmethod
    def from_lens(
        width_px: int, height_px: int, pixel_pitch_um: float, focal_length_mm: float, focus_distance_mm: float
    ) -> Pinhole:
        """Focused at `focus_distance_mm` the image stands at 1/(1/f - 1/focus) behind the lens."""
        image_distance_mm = 1.0 / (1.0 / focal_length_mm - 1.0 / focus_distance_mm)
        return Pinhole(width_px, height_px, image_distance_mm * 1e3 / pixel_pitch_um)


@numba.njit(cache=True, nogil=True)
def _rasterise(corners, base_to_camera, focal, width, height, near, triangle_of_pixel, depth):  # type: ignore[no-untyped-def]
    half_w, half_h = 0.5 * width - 0.5, 0.5 * height - 0.5
    u, v, w = np.empty(3), np.empty(3), np.empty(3)
    for t in range(len(corners)):
        behind = False
        for k in range(3):
            x, y, z = corners[t, k, 0], corners[t, k, 1], corners[t, k, 2]
            m = base_to_camera
            cz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if cz < near:
                behind = True
                break
            w[k] = 1.0 / cz
            u[k] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * w[k] * focal + half_w
            v[k] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * w[k] * focal + half_h
        if behind:
            continue
        area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
        if area == 0.0:
            continue
        first_col = max(0, int(np.ceil(min(u[0], u[1], u[2]))))
        last_col = min(width - 1, int(np.floor(max(u[0], u[1], u[2]))))
        first_row = max(0, int(np.ceil(min(v[0], v[1], v[2]))))
        last_row = min(height - 1, int(np.floor(max(v[0], v[1], v[2]))))
        for row in range(first_row, last_row + 1):
            for col in range(first_col, last_col + 1):
                b0 = ((u[1] - col) * (v[2] - row) - (u[2] - col) * (v[1] - row)) / area
                b1 = ((u[2] - col) * (v[0] - row) - (u[0] - col) * (v[2] - row)) / area
                b2 = 1.0 - b0 - b1
                if b0 < 0 or b1 < 0 or b2 < 0:
                    continue
                inverse_z = b0 * w[0] + b1 * w[1] + b2 * w[2]
                if inverse_z > depth[row, col]:
                    depth[row, col] = inverse_z
                    triangle_of_pixel[row, col] = t


@dataclass(frozen=True)
class View:
    """What one camera pose sees: `triangle` [h, w], index into `seen` or -1; `seen` are scene triangles."""

    triangle: NDArray[np.int32]
    seen: NDArray[np.int64]
    towards_camera: NDArray[np.float64]
    """[seen] cosine of the angle between normal and direction to the camera; its sign picks the side lit."""
    falloff: NDArray[np.float32]
    """[h, w] natural vignetting, cos^4."""


def rasterise(scene: Scene, pinhole: Pinhole, base_from_camera: Transform) -> View:
    """Z-buffer the scene from a camera pose."""
    shape = (pinhole.height_px, pinhole.width_px)
    triangle, depth = np.full(shape, -1, np.int32), np.zeros(shape, np.float32)
    to_camera = inverse(base_from_camera)
    _rasterise(scene.corners_mm, to_camera, pinhole.focal_px, *shape[::-1], _NEAR_MM, triangle, depth)
    seen, compact = np.unique(triangle, return_inverse=True)
    first = int(seen[0] == -1)
    towards = base_from_camera[:3, 3] - scene.centroids_mm[seen[first:]]
    cosine = np.einsum("ij,ij->i", scene.normals[seen[first:]], towards) / np.linalg.norm(towards, axis=1)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    tangent2 = (cols - shape[1] / 2 + 0.5) ** 2 + (rows - shape[0] / 2 + 0.5) ** 2
    falloff = (1.0 + tangent2 / pinhole.focal_px**2) ** -2
    return View(
        (compact.reshape(shape) - first).astype(np.int32),
        seen[first:].astype(np.int64),
        cosine,
        falloff.astype(np.float32),
    )


def led_radiance(scene: Scene, view: View, leds: Leds, led: int, emission: str) -> NDArray[np.float32]:
    """Radiance [seen, 3] in lm/(m^2 sr) that triangles send to the camera when one LED is lit.

    E = Phi/(pi d^2) cos_emitter cos_receiver for a Lambertian emitter; `paper` takes the emitter's cosine
    twice (seed 003, Eq. 2; facts/instrument). L = albedo E / pi.
    """
    to_light = leds.positions_mm[led] - scene.centroids_mm[view.seen]
    distance_mm = np.linalg.norm(to_light, axis=1)
    cos_emitter = np.maximum(0.0, -(to_light @ leds.normals[led]) / distance_mm)
    side = np.where(view.towards_camera >= 0, 1.0, -1.0)
    cos_receiver = np.einsum("ij,ij->i", scene.normals[view.seen], to_light) / distance_mm * side
    power = 2 if emission == "paper" else 1
    lux = leds.flux_lm[led] / np.pi / (distance_mm * 1e-3) ** 2 * cos_emitter**power
    lux *= np.maximum(0.0, cos_receiver)
    radiance: NDArray[np.float32] = (lux[:, None] * scene.albedo[view.seen] / np.pi).astype(np.float32)
    return radiance


def panel_radiance(scene: Scene, view: View, panel_lux: float) -> NDArray[np.float32]:
    """Radiance [seen, 3] under a panel: the same irradiance everywhere (a flat white panel is meant so)."""
    radiance: NDArray[np.float32] = (panel_lux * scene.albedo[view.seen] / np.pi).astype(np.float32)
    return radiance

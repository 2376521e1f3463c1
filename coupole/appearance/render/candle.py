"""A candle: a flame that emits, on a stem of wax.

The flame is a body of revolution, r proportional to sqrt(t) (1 - t) of its height, that emits the same radiance
everywhere. Its intensity in a direction is this radiance times its area as seen from this direction. The candela
was once the intensity of such a flame from the side.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from coupole.appearance.render.materials import Diffuse, Material
from coupole.appearance.render.model import Model, Positive, Vector
from coupole.appearance.render.spectra import BlackBody, Constant, Power
from coupole.appearance.shapes.triangles import disk, grid_faces
from coupole.appearance.spectra.grid import Array

_AROUND, _ALONG = 16, 10
_GAP_MM = 3.0
"""Gap from the wax to the flame."""
_MM2 = 1e-6
_WAX = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.75))


class Candle(Model):
    """A burning candle that stands upright; it has no wax without `wax_height_mm`."""

    kind: Literal["candle"]
    position_mm: Vector
    """Position of the candle's foot."""
    intensity_cd: Positive = 1.0
    """Intensity to the side."""
    flame_height_mm: Positive = 28.0
    flame_width_mm: Positive = 9.0
    wax_height_mm: Annotated[float, Field(ge=0)] = 180.0
    wax_diameter_mm: Positive = 24.0
    wax: Material = _WAX
    spectrum: Power = BlackBody(kind="black_body", kelvin=1900.0)

    def luminance_cd_m2(self) -> float:
        """Return the luminance of the flame."""
        return self.intensity_cd / (seen_area_mm2(flame(self)) * _MM2)


def flame(candle: Candle) -> Array:
    """Corners [n, 3, 3] in the scene's frame."""
    along = np.linspace(0.0, 1.0, _ALONG + 1) ** 1.5
    outline = np.sqrt(along) * (1.0 - along)
    radius = 0.5 * candle.flame_width_mm * outline / (np.sqrt(1.0 / 3.0) * 2.0 / 3.0)
    foot = np.add(candle.position_mm, [0.0, 0.0, candle.wax_height_mm + _GAP_MM])
    body = _revolved_corners(radius, candle.flame_height_mm * along)
    areas = np.linalg.norm(np.cross(body[:, 1] - body[:, 0], body[:, 2] - body[:, 0]), axis=1)
    return np.asarray(body[areas > 0.0] + foot)


def stem(candle: Candle) -> Array:
    """Corners [n, 3, 3] of the wax, in the scene's frame."""
    radius = 0.5 * candle.wax_diameter_mm
    side = _revolved_corners(np.array([radius, radius]), np.array([0.0, candle.wax_height_mm]))
    top = disk(radius, _AROUND, z_mm=candle.wax_height_mm)
    return np.asarray(np.concatenate([side, top]) + np.asarray(candle.position_mm))


def seen_area_mm2(corners_mm: Array) -> float:
    """Return the area of a convex body as seen from the side, the mean over azimuths (Cauchy)."""
    double_areas = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    return float(np.hypot(double_areas[:, 0], double_areas[:, 1]).sum() / (2.0 * np.pi))


def _revolved_corners(radius_mm: Array, z_mm: Array) -> Array:
    """Corners of the surface that an outline [n] makes about the z axis, facing outwards."""
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND + 1)
    x, y = radius_mm[:, None] * np.cos(angle), radius_mm[:, None] * np.sin(angle)
    points = np.stack([x, y, np.broadcast_to(z_mm[:, None], x.shape)], axis=-1).reshape(-1, 3)
    return np.asarray(points[grid_faces(len(radius_mm) - 1, _AROUND)])

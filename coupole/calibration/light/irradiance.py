"""Irradiance by an LED, which is a finite square that radiates by Lambert's law.

The processing does not share this formula with the simulator. It is Lambert's formula for a polygon (Photometria,
1760; Lucat et al. 2025, Eq. 2 and supplement). With unit vectors v_i from the point to the corners, it is G =
sum_i angle(v_i, v_i+1) * unit(v_i x v_i+1), and E = Phi / (2 A) * G.n / pi for a flux Phi that leaves the square
of area A. The factor 1 / pi is that of a Lambertian emitter's radiance, Phi / (pi A).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from coupole.calibration.rotations import Floats

Emission = Literal["lambertian", "paper"]
LED_SIDE_MM = 7.0


def led_corners_mm(centre_mm: ArrayLike, normal: ArrayLike, side_mm: float = LED_SIDE_MM) -> Floats:
    """Return [..., 4, 3], corners of squares about `centre_mm` [..., 3] that face along the unit `normal` [...,
    3].

    The direction of the sides is not measured: at 1 m it changes irradiance by less than 1e-6.
    """
    centre, axis = np.broadcast_arrays(np.asarray(centre_mm, float), np.asarray(normal, float))
    helper = np.where(np.abs(axis[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(axis, u)
    half = side_mm / 2.0
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    corners: Floats = centre[..., None, :] + signs[:, :1] * u[..., None, :] + signs[:, 1:] * v[..., None, :]
    return corners


def lambert_vector(points_mm: ArrayLike, corners_mm: ArrayLike) -> Floats:
    """Return G [..., 3] of polygons [..., k, 3] at points [..., 3]. It points to the light, and |G| is twice the
    largest projected solid angle. As seen from points in front of the polygon, its corners run clockwise about its
    normal."""
    towards = np.asarray(corners_mm, float) - np.asarray(points_mm, float)[..., None, :]
    unit = towards / np.sqrt(np.einsum("...i,...i", towards, towards))[..., None]
    after = np.roll(unit, -1, axis=-2)
    cross = _cross(after, unit)
    sine = np.sqrt(np.einsum("...i,...i", cross, cross))
    cosine = np.einsum("...i,...i", unit, after)
    # angle / sine tends to 1 for neighbours that coincide.
    turn = np.where(sine > 1e-15, np.arctan2(sine, cosine) / np.maximum(sine, 1e-300), 1.0)
    vector: Floats = np.einsum("...k,...ki", turn, cross)
    return vector


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product [..., 3]. This is several times faster than numpy's function for many
    short vectors."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def irradiance_per_flux(
    points_mm: ArrayLike,
    normals: ArrayLike,
    led_centres_mm: ArrayLike,
    led_normals: ArrayLike,
    *,
    side_mm: float = LED_SIDE_MM,
    emission: Emission = "lambertian",
) -> Floats:
    """Return E / Phi in m^-2 at points [..., 3] with unit normals [..., 3]. All arguments are broadcast.

    It is 0 for a point behind the LED, or an LED whose centre is below the point's horizon. At a metre the LED's
    size matters only within less than half a degree of the horizon. `paper` has the emitter's cosine twice (Lucat
    et al. 2025, Eq. 2).
    """
    points, facing = np.asarray(points_mm, float), np.asarray(normals, float)
    centres, axes = np.asarray(led_centres_mm, float), np.asarray(led_normals, float)
    vector = lambert_vector(points, led_corners_mm(centres, axes, side_mm))
    area_m2 = (side_mm * 1e-3) ** 2
    towards = centres - points
    distance = np.linalg.norm(towards, axis=-1)
    cos_led = -np.sum(towards * axes, axis=-1) / distance
    is_lit = (cos_led > 0.0) & (np.sum(towards * facing, axis=-1) > 0.0)
    value = np.sum(vector * facing, axis=-1) / (2.0 * np.pi * area_m2)
    if emission == "paper":
        value = value * cos_led
    result: Floats = np.where(is_lit, np.maximum(value, 0.0), 0.0)
    return result

"""Irradiance from a square Lambertian emitter at a point.

E is Phi / (2 pi A) times a sum over the edges of the part above the receiver's horizon. The term of edge i is
angle_i (edge_i's normal . n). The formula is from Lambert (1760) and Lucat et al. 2025, Eq. 2; there `paper`
multiplies by the emitter's cosine once more. Lengths are in mm, except that E / Phi is per m^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.kernels import kernel

LED_SIDE_MM = 7.0
FAR_SIDES = 36.0
"""Distance in sides. From this distance on, 2 x 2 Gauss points differ from the polygon by less than 1e-6 if the
whole emitter is above the horizon (measured in tests/sim/render/test_emitter.py)."""
_GAUSS = 1.0 / np.sqrt(3.0)


@dataclass(frozen=True)
class Emitter:
    """A square in the base frame."""

    centre_mm: NDArray[np.float64]
    normal: NDArray[np.float64]
    """Unit; light leaves on this side."""
    half_u_mm: NDArray[np.float64]
    """Vector from the centre to the middle of one side."""
    half_v_mm: NDArray[np.float64]
    """Vector from the centre to the middle of the next side: u x v points along the normal."""
    flux_lm: float


def square(centre_mm: ArrayLike, normal: ArrayLike, *, side_mm: float, flux_lm: float) -> Emitter:
    """Emitter with two sides horizontal (perpendicular to z; along x if it faces straight up or down).

    The LED table does not give the orientation of squares; at 1 m it changes the irradiance by at most 1e-5.
    """
    (emitter,) = squares(np.atleast_2d(centre_mm), np.atleast_2d(normal), side_mm=side_mm, fluxes_lm=[flux_lm])
    return emitter


def squares(centres_mm: ArrayLike, normals: ArrayLike, *, side_mm: float, fluxes_lm: ArrayLike) -> list[Emitter]:
    """`square` for each of centres [n, 3], normals [n, 3] and fluxes [n]."""
    n = np.asarray(normals, dtype=np.float64)
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    u = np.cross([0.0, 0.0, 1.0], n)
    length = np.linalg.norm(u, axis=1, keepdims=True)
    u = np.where(length > 1e-9, u / np.where(length > 1e-9, length, 1.0), [1.0, 0.0, 0.0])
    half_u, half_v = 0.5 * side_mm * u, 0.5 * side_mm * np.cross(n, u)
    centres, fluxes = np.asarray(centres_mm, dtype=np.float64), np.asarray(fluxes_lm, dtype=np.float64)
    return [Emitter(*geometry) for geometry in zip(centres, n, half_u, half_v, fluxes.tolist(), strict=True)]


def irradiance(
    emitter: Emitter, points_mm: ArrayLike, normals: ArrayLike, emission: str = "lambertian"
) -> NDArray[np.float64]:
    """[n] lux at points [n, 3] with unit normals [n, 3], unobstructed."""
    points, facing = (
        np.atleast_2d(np.ascontiguousarray(points_mm, np.float64)),
        np.atleast_2d(np.ascontiguousarray(normals, np.float64)),
    )
    out = np.empty(len(points))
    _irradiance(points, facing, packed_emitter(emitter), out)
    if emission == "paper":
        to_light = emitter.centre_mm - points
        out *= np.maximum(0.0, -(to_light @ emitter.normal) / np.linalg.norm(to_light, axis=1))
    return out


def irradiance_of_each(emitters: Sequence[Emitter], point_mm: ArrayLike, normal: ArrayLike) -> NDArray[np.float64]:
    """[emitters] lux that each gives at one point [3] with unit normal [3], Lambertian, nothing in between."""
    out = np.empty(len(emitters))
    leds = np.array([packed_emitter(emitter) for emitter in emitters]).reshape(-1, 13)
    _irradiance_of_each(np.asarray(point_mm, np.float64), np.asarray(normal, np.float64), leds, out)
    return out


def packed_emitter(emitter: Emitter) -> NDArray[np.float64]:
    """[13] centre, normal, half_u, half_v in mm, and flux in lm, for compiled code."""
    return np.array([*emitter.centre_mm, *emitter.normal, *emitter.half_u_mm, *emitter.half_v_mm, emitter.flux_lm])


@kernel
def _irradiance(points, normals, led, out):  # type: ignore[no-untyped-def]
    shares = np.empty(4)
    work = np.empty((2, 8, 3))
    for i in range(len(points)):
        p, n = points[i], normals[i]
        out[i] = led[12] * per_lumen(p[0], p[1], p[2], n[0], n[1], n[2], led, shares, work)


@kernel
def _irradiance_of_each(p, n, leds, out):  # type: ignore[no-untyped-def]
    shares = np.empty(4)
    work = np.empty((2, 8, 3))
    for i in range(len(leds)):
        out[i] = leds[i, 12] * per_lumen(p[0], p[1], p[2], n[0], n[1], n[2], leds[i], shares, work)


@kernel
def per_lumen(px, py, pz, nx, ny, nz, led, shares, work):  # type: ignore[no-untyped-def]
    """E / Phi in 1/m^2 at p with unit normal n; fills `shares` [4] with the four Gauss points' contributions.

    `work` [2, 8, 3] is memory for the polygon. Without light the shares are 0.
    """
    tx, ty, tz = led[0] - px, led[1] - py, led[2] - pz
    shares[:] = 0.0
    if tx * led[3] + ty * led[4] + tz * led[5] >= 0.0:
        return 0.0
    total = 0.0
    for k in range(4):
        u, v = (_GAUSS, -_GAUSS)[k & 1], (_GAUSS, -_GAUSS)[k >> 1]
        x, y, z = tx + u * led[6] + v * led[9], ty + u * led[7] + v * led[10], tz + u * led[8] + v * led[11]
        distance2 = x * x + y * y + z * z
        cosines = -(x * led[3] + y * led[4] + z * led[5]) * max(0.0, x * nx + y * ny + z * nz)
        shares[k] = 0.25e6 / np.pi * cosines / (distance2 * distance2)
        total += shares[k]
    half2 = led[6] * led[6] + led[7] * led[7] + led[8] * led[8]
    distance2 = tx * tx + ty * ty + tz * tz
    height = tx * nx + ty * ny + tz * nz
    # From the centre to the highest corner; near the horizon the points need some room.
    reach = abs(led[6] * nx + led[7] * ny + led[8] * nz) + abs(led[9] * nx + led[10] * ny + led[11] * nz)
    if distance2 < 4.0 * half2 * FAR_SIDES * FAR_SIDES or height < 2.0 * reach:
        exact = _polygon(tx, ty, tz, nx, ny, nz, led, work) / (8.0 * np.pi * half2) * 1e6
        if total > 0.0:
            for k in range(4):
                shares[k] *= exact / total
        return exact
    return total


@kernel
def _polygon(tx, ty, tz, nx, ny, nz, led, work):  # type: ignore[no-untyped-def]
    """Lambert's sum over the edges of the square, clipped at the horizon; (tx, ty, tz) points to its centre."""
    whole, above = work[0], work[1]
    for k in range(4):
        u = 1.0 if k in (0, 3) else -1.0
        v = 1.0 if k < 2 else -1.0
        whole[k, 0] = tx + u * led[6] + v * led[9]
        whole[k, 1] = ty + u * led[7] + v * led[10]
        whole[k, 2] = tz + u * led[8] + v * led[11]
    count = 0
    for k in range(4):
        a, b = whole[k], whole[(k + 1) % 4]
        height_a = a[0] * nx + a[1] * ny + a[2] * nz
        height_b = b[0] * nx + b[1] * ny + b[2] * nz
        if height_a >= 0.0:
            above[count] = a
            count += 1
        if (height_a >= 0.0) != (height_b >= 0.0):
            share = height_a / (height_a - height_b)
            for i in range(3):
                above[count, i] = a[i] + share * (b[i] - a[i])
            count += 1
    total = 0.0
    for k in range(count):
        a, b = above[k], above[(k + 1) % count]
        cx, cy, cz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        length = np.sqrt(cx * cx + cy * cy + cz * cz)
        if length > 0.0:
            angle = np.arctan2(length, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
            total += angle / length * (cx * nx + cy * ny + cz * nz)
    return abs(total)

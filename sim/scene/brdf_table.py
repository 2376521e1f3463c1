"""A reflectance of any form as a table for the renderer, in the angles of Rusinkiewicz, A new change of variables
for efficient BRDF representation (1998).

The table has three axes. theta_h is the angle between half vector and normal; its nodes are dense near 0, where
lobes are narrow. theta_d is the angle between light and half vector. phi_d is the azimuth of the light about the
half vector. Reciprocity and the mirror symmetry of isotropic surfaces leave 0 to 90 degrees of phi_d. Values
between the nodes are interpolated linearly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.brdf import Brdf
from coupole.kernels import kernel

NODES = (80, 48, 12)
"""Number of nodes of theta_h, theta_d and phi_d."""
_LOWEST_Z = 2e-3
"""Least height of a direction above the horizon. Nodes below the horizon take the value there, for
interpolation."""
_CHUNK = 8
"""Angles theta_h that are evaluated together."""


def tabulate(brdf: Brdf, weights: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return [theta_h, theta_d, phi_d, 3] per steradian for a reciprocal and isotropic `brdf`. A camera with the
    spectral `weights` [3, bands] sees it; each row of weights sums to 1."""
    theta_h = 0.5 * np.pi * np.linspace(0.0, 1.0, NODES[0]) ** 2
    theta_d, phi_d = (0.5 * np.pi * np.linspace(0.0, 1.0, n) for n in NODES[1:])
    parts = []
    for first in range(0, NODES[0], _CHUNK):
        light, view = _directions(*np.ix_(theta_h[first : first + _CHUNK], theta_d, phi_d))
        reciprocal_mean = 0.5 * (
            brdf(_lift_above_horizon(light), _lift_above_horizon(view))
            + brdf(_lift_above_horizon(view), _lift_above_horizon(light))
        )
        parts.append(np.asarray(reciprocal_mean @ weights.T, np.float32))
    return np.concatenate(parts)


def _directions(
    theta_h: NDArray[np.float64], theta_d: NDArray[np.float64], phi_d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return light and view [..., 3] for angles. They are turned about y by theta_h from the place where the half
    vector is the normal."""
    x, y, z = np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d), np.cos(theta_d)

    def turned_about_y(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        across, along = np.cos(theta_h) * x + np.sin(theta_h) * z, np.cos(theta_h) * z - np.sin(theta_h) * x
        return np.stack(np.broadcast_arrays(across, y, along), axis=-1)

    return turned_about_y(x, y), turned_about_y(-x, -y)


def _lift_above_horizon(way: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the directions [..., 3], raised to the least height above the horizon."""
    z = np.maximum(way[..., 2], _LOWEST_Z)
    shrink = np.sqrt(1.0 - z**2) / np.maximum(np.hypot(way[..., 0], way[..., 1]), 1e-12)
    return np.stack([way[..., 0] * shrink, way[..., 1] * shrink, z], axis=-1)


@kernel
def look_up(table, nx, ny, nz, lx, ly, lz, vx, vy, vz, out):  # type: ignore[no-untyped-def]
    """Write into `out` [3] the value of a table for unit normal, light and view; light and view must be above the
    horizon."""
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx / length, hy / length, hz / length
    # Angles from chords: cosines near 1 would lose digits.
    ax, ay, az = hx - nx, hy - ny, hz - nz
    theta_h = 2.0 * np.arcsin(min(1.0, 0.5 * np.sqrt(ax * ax + ay * ay + az * az)))
    bx, by, bz = lx - vx, ly - vy, lz - vz
    theta_d = np.arcsin(min(1.0, 0.5 * np.sqrt(bx * bx + by * by + bz * bz)))
    # The light's azimuth about the half vector, from the side away from the normal.
    cosine = nx * hx + ny * hy + nz * hz
    tx, ty, tz = cosine * hx - nx, cosine * hy - ny, cosine * hz - nz
    sx, sy, sz = hy * tz - hz * ty, hz * tx - hx * tz, hx * ty - hy * tx
    along, aside = abs(bx * tx + by * ty + bz * tz), abs(bx * sx + by * sy + bz * sz)
    phi_d = np.arctan2(aside, along)
    first, second, third = table.shape[0] - 1, table.shape[1] - 1, table.shape[2] - 1
    u = min(np.sqrt(theta_h / (0.5 * np.pi)) * first, first - 1e-9)
    # Nodes of theta_h are squares of even steps: the share between two of them is that of the angle itself.
    i = int(u)
    u = (theta_h / (0.5 * np.pi) * first * first - i * i) / (2.0 * i + 1.0)
    v, w = min(theta_d / (0.5 * np.pi) * second, second - 1e-9), min(phi_d / (0.5 * np.pi) * third, third - 1e-9)
    j, k = int(v), int(w)
    v, w = v - j, w - k
    for c in range(3):
        out[c] = 0.0
    for a in range(2):
        for b in range(2):
            for d in range(2):
                share = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if d else 1.0 - w)
                for c in range(3):
                    out[c] += share * table[i + a, j + b, k + d, c]

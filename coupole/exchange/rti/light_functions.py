"""Functions of the direction to a light. Viewers add them up with the coefficients of each pixel.

Directions are unit vectors: x right, y up, z to the camera.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.light_interpolation import weights

Floats = NDArray[np.float64]

_KERNEL = "linear"
_DENSE_PER_NODE = 20
_UNLIT_WEIGHT = 0.03
"""Weight of directions far from any light, where interpolation is unreliable, relative to directions among the
lights."""


def ptm(directions: Floats) -> Floats:
    """[n, 6] values of 1, x, y, x2, xy, y2 (Malzbender and others 2001, equation 1)."""
    x, y, _ = directions.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def hsh(directions: Floats) -> Floats:
    """[n, 9] hemispherical harmonics of degrees 0 to 2 (Gautron and others 2004): spherical harmonics of the
    elevation 2 cos(theta) - 1; within a degree, the order is cos, zonal, sin."""
    x, y, z = directions.T
    phi, cos = np.arctan2(y, x), np.clip(z, 0.0, 1.0)
    side = np.sqrt(cos - cos * cos)
    terms = [
        np.full_like(x, math.sqrt(1 / (2 * math.pi))),
        math.sqrt(6 / math.pi) * side * np.cos(phi),
        math.sqrt(3 / (2 * math.pi)) * (2 * cos - 1),
        math.sqrt(6 / math.pi) * side * np.sin(phi),
        -math.sqrt(30 / math.pi) * side**2 * np.cos(2 * phi),
        math.sqrt(30 / math.pi) * side * (2 * cos - 1) * np.cos(phi),
        math.sqrt(5 / (2 * math.pi)) * (6 * cos * cos - 6 * cos + 1),
        math.sqrt(30 / math.pi) * side * (2 * cos - 1) * np.sin(phi),
        -math.sqrt(30 / math.pi) * side**2 * np.sin(2 * phi),
    ]
    return np.stack(terms, axis=1)


def gaussian(directions: Floats, lights: Floats, sigma: float) -> Floats:
    """[n, lights] Gaussians of the distance between unit vectors; each row adds up to 1."""
    distances2 = np.sum((directions[:, None] - lights[None]) ** 2, axis=2)
    nearest2 = distances2.min(axis=1, keepdims=True)
    values = np.exp((nearest2 - distances2) / sigma**2)
    return np.asarray(values / values.sum(axis=1, keepdims=True))


def bilinear(directions: Floats, resolution: int) -> Floats:
    """[n, resolution^2] weights of the nodes of a grid, row by row: the octahedron's upper half, seen from above
    and rotated by 45 degrees, so that it fills the square."""
    across, up, _ = (directions / np.abs(directions).sum(axis=1, keepdims=True)).T
    place = (np.stack([across + up, up - across], axis=1) + 1.0) / 2.0 * (resolution - 1)
    corner = np.clip(np.floor(place).astype(np.int64), 0, resolution - 2)
    beyond = place - corner
    shares = np.zeros((len(directions), resolution * resolution))
    rows = np.arange(len(directions))
    for column in (0, 1):
        for row in (0, 1):
            share = np.abs(1 - column - beyond[:, 0]) * np.abs(1 - row - beyond[:, 1])
            shares[rows, corner[:, 0] + column + (corner[:, 1] + row) * resolution] = share
    return shares


def bilinear_nodes(lights: Floats, resolution: int) -> Floats:
    """[resolution^2, lights] matrix from values under the lights to values of the nodes. It gives the bilinear
    function that is nearest to interpolation by radial functions over the hemisphere."""
    directions = _half_sphere(_DENSE_PER_NODE * resolution * resolution)
    between = np.sort(np.linalg.norm(lights[:, None] - lights[None], axis=2), axis=1)[:, 1]
    away = np.array([np.linalg.norm(lights - direction, axis=1).min() for direction in directions])
    trust = np.where(away < 2.0 * np.median(between), 1.0, _UNLIT_WEIGHT)[:, None]
    shares, goal = bilinear(directions, resolution), weights(lights, directions, _KERNEL)
    return np.asarray(np.linalg.lstsq(trust * shares, trust * goal, rcond=None)[0])


def _half_sphere(count: int) -> Floats:
    """[count, 3] unit vectors, evenly spread over the upper half (a spiral of golden angles)."""
    numbers = np.arange(count) + 0.5
    z, turn = 1.0 - numbers / count, math.pi * (3.0 - math.sqrt(5.0)) * numbers
    side = np.sqrt(1.0 - z * z)
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)

"""A table over half angle, difference angle and its azimuth, fitted to scattered samples of an isotropic finish.

Rusinkiewicz, "A new change of variables for efficient BRDF representation" (1998). A photograph of a sphere under
one distant light has one difference angle: half the angle between light and camera. In these coordinates its
samples fill one layer of the table, and values between two photographs are chosen so that they are smooth along
theta_d. In coordinates about the mirror direction, the samples of a photograph would be oblique, and a peak
between two photographs would be lost.

The azimuth goes only from 0 to 90 degrees. Exchange of the directions and mirror symmetry map all other
directions to this range, so the table is always reciprocal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.brdf import half_vector

Array = NDArray[np.float64]
_THETAS_H, _THETAS_D, _PHIS = 28, 19, 3
SHAPE = (_THETAS_H, _THETAS_D, _PHIS)
_NODES = (
    0.5 * np.pi * np.linspace(0.0, 1.0, _THETAS_H) ** 2,  # dense about the peak
    0.5 * np.pi * np.linspace(0.0, 1.0, _THETAS_D),
    0.5 * np.pi * np.linspace(0.0, 1.0, _PHIS),
)
_BENDS = ((0, 1.0), (1, 10.0), (2, 10.0))
"""Axes of the table, and for each axis the cost of a second difference along it."""
_MIXED = 30.0
"""Cost of a change with theta_h of the dependence on theta_d, because within a lobe only Fresnel's factor depends
on theta_d."""
_POLE = 30.0
"""Cost of a change with azimuth where the half vector is the normal, because there is no azimuth there."""
_VALUE = 1e-3
"""Cost of a value, so that the table corrects nothing where nothing is known."""


def half_coordinates(ways_in: Array, ways_out: Array) -> tuple[Array, Array, Array]:
    """theta_h, theta_d and the folded azimuth phi_d, radians [n], of unit directions [n, 3]."""
    half, _ = half_vector(ways_in, ways_out)
    theta_h = np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2])
    theta_d = np.arctan2(
        np.linalg.norm(ways_in - ways_out, axis=1), np.maximum(np.linalg.norm(ways_in + ways_out, axis=1), 1e-12)
    )
    normal = np.array([0.0, 0.0, 1.0]) - half * half[:, 2:]
    across = ways_in - half * np.sum(ways_in * half, axis=1, keepdims=True)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(across, axis=1)
    cosine = np.abs(np.sum(normal * across, axis=1)) / np.maximum(lengths, 1e-12)
    return theta_h, theta_d, np.arccos(np.minimum(cosine, 1.0))


def interpolation(ways_in: Array, ways_out: Array) -> Any:
    """Sparse [n, entries]: weights of the nodes around each direction."""
    from scipy.sparse import coo_matrix

    coordinates = half_coordinates(ways_in, ways_out)
    places = [_between(nodes, at) for nodes, at in zip(_NODES, coordinates, strict=True)]
    rows, columns, shares = [], [], []
    for corner in np.ndindex(2, 2, 2):
        index = [low + side for (low, _), side in zip(places, corner, strict=True)]
        rows.append(np.arange(len(ways_in)))
        columns.append(np.ravel_multi_index(index, SHAPE))
        parts = [share if side else 1.0 - share for (_, share), side in zip(places, corner, strict=True)]
        shares.append(np.prod(parts, axis=0))
    entries = np.concatenate(shares), (np.concatenate(rows), np.concatenate(columns))
    return coo_matrix(entries, (len(ways_in), int(np.prod(SHAPE)))).tocsr()


def smooth_table(design: Any, values: Array, smoothness: float) -> Array:
    """[entries, bands] table that is nearest to `values` [n, bands] at the rows of `design`, and smooth where
    there are none."""
    from scipy.sparse.linalg import splu

    per_entry = len(values) / np.prod(SHAPE)
    normal = (design.T @ design + smoothness * per_entry * _roughness()).tocsc()
    return np.asarray(splu(normal).solve(np.ascontiguousarray(design.T @ values)))


def _roughness() -> Any:
    """[entries, entries] matrix of the squared terms that the fit keeps small."""
    from scipy.sparse import diags, eye, kron

    unit = [eye(count) for count in SHAPE]
    first = [diags([-1.0, 1.0], [0, 1], shape=(count - 1, count)) for count in SHAPE]
    pole = diags([1.0], [0], shape=(1, _THETAS_H))
    level = diags([-1.0, 1.0], [0, 1], shape=(1, _THETAS_H))
    parts = [
        (_VALUE, unit),
        (_POLE, [pole, unit[1], first[2]]),
        (_POLE, [level, unit[1], unit[2]]),
        (_MIXED, [first[0], first[1], unit[2]]),
    ]
    for axis, weight in _BENDS:
        second = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(SHAPE[axis] - 2, SHAPE[axis]))
        parts.append((weight, [second if k == axis else unit[k] for k in range(3)]))
    squares = [weight * _square(kron(kron(a, b), c)) for weight, (a, b, c) in parts]
    return sum(squares[1:], squares[0])


def _square(operator: Any) -> Any:
    return operator.T @ operator


def _between(nodes: Array, where: Array) -> tuple[NDArray[np.intp], Array]:
    low = np.clip(np.searchsorted(nodes, where) - 1, 0, len(nodes) - 2)
    return low, np.clip((where - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)

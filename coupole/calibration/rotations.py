"""Rotation vectors [..., 3] in radians and rotation matrices [..., 3, 3], many at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_SMALL_RAD = 1e-8


def skew(vectors: ArrayLike) -> Floats:
    """Return matrices [..., 3, 3] that take the cross product with vectors [..., 3] from the left: skew(v) w = v x
    w."""
    v = np.asarray(vectors, dtype=np.float64)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    nought = np.zeros_like(x)
    return np.stack([nought, -z, y, z, nought, -x, -y, x, nought], axis=-1).reshape(*v.shape[:-1], 3, 3)


def rotation(vectors_rad: ArrayLike) -> Floats:
    """Return the rotation matrices of rotation vectors (Rodrigues' formula)."""
    v = np.asarray(vectors_rad, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    across = skew(v)
    sine = np.sinc(angle / np.pi)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    rotations: Floats = np.eye(3) + sine * across + versine * (across @ across)
    return rotations


def quaternion(rotations: ArrayLike) -> Floats:
    """Return the unit quaternions [..., 4] (w, x, y, z), w >= 0, of rotation matrices.

    The result is the column of q q^T with the largest norm; q q^T is linear in R (Bar-Itzhack, J. Guidance 23(6),
    2000). So no digits are lost near special angles.
    """
    r = np.asarray(rotations, dtype=np.float64)
    outer = np.empty((*r.shape[:-2], 4, 4))
    trace = np.trace(r, axis1=-2, axis2=-1)
    outer[..., 0, 0] = 1 + trace
    outer[..., 1:, 1:] = r + np.swapaxes(r, -1, -2) + (1 - trace)[..., None, None] * np.eye(3)
    axis = np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], axis=-1
    )
    outer[..., 0, 1:] = outer[..., 1:, 0] = axis
    best = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    quaternions: Floats = np.where(q[..., :1] < 0, -q, q)
    return quaternions


def rotation_vector(rotations: ArrayLike) -> Floats:
    """Return the rotation vectors of rotation matrices, with angles from 0 to pi."""
    q = quaternion(rotations)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    stretch = np.where(sine > _SMALL_RAD, 2 * half / np.where(sine > _SMALL_RAD, sine, 1.0), 2.0)
    vectors: Floats = stretch * q[..., 1:]
    return vectors


def nearest_rotation(matrices: ArrayLike) -> Floats:
    """Return the rotation nearest to a matrix [..., 3, 3] (polar decomposition; determinant +1)."""
    u, _, vt = np.linalg.svd(np.asarray(matrices, dtype=np.float64))
    turn: Floats = np.asarray(u @ vt)
    signs = np.ones((*turn.shape[:-2], 3))
    signs[..., 2] = np.sign(np.linalg.det(turn))
    return np.asarray(u * signs[..., None, :] @ vt)


def moved_transforms(a_from_b: Floats, steps: Floats) -> Floats:
    """Return transforms [..., 4, 4] after small steps [..., 6]. The translation is added (mm); the rotation is
    applied from the right (rad)."""
    result = a_from_b.copy()
    result[..., :3, 3] += steps[..., :3]
    result[..., :3, :3] = a_from_b[..., :3, :3] @ rotation(steps[..., 3:])
    return result


def between(a_from_b: Floats, other_transforms: Floats) -> Floats:
    """Return the step [..., 6] (mm, rad) with which `moved_transforms` changes the first transforms into the
    others."""
    turn = np.swapaxes(a_from_b[..., :3, :3], -1, -2) @ other_transforms[..., :3, :3]
    return np.concatenate([other_transforms[..., :3, 3] - a_from_b[..., :3, 3], rotation_vector(turn)], axis=-1)


def inverses(a_from_b: Floats) -> Floats:
    """Return `b_from_a` for transforms [..., 4, 4]."""
    result = np.zeros_like(a_from_b)
    inverse_turns = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    result[..., :3, :3] = inverse_turns
    result[..., :3, 3] = -(inverse_turns @ a_from_b[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result

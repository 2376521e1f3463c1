"""Ambient occlusion: the share of a uniform sky's light that reaches places of a mesh past the mesh itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.motion.packet_rays import PacketMesh

Floats = NDArray[np.float64]

RAYS = 64
_OFF = 1e-4
"""Distance from the surface at which rays begin, as a share of the object's size."""
_BLOCK = 1 << 16


def open_sky(corners_mm: Floats, places_mm: Floats, normals: Floats) -> Floats:
    """[n] shares, 0 to 1, at places [n, 3] with unit normals [n, 3], among triangles [m, 3, 3].

    Light is weighted by its cosine. `RAYS` rays are used, the same around each normal.
    """
    mesh = PacketMesh(corners_mm)
    width_mm = float(np.ptp(corners_mm.reshape(-1, 3), axis=0).sum())
    off_mm, local = _OFF * width_mm, width_mm * _cosine_ways(RAYS)
    shares = np.empty(len(places_mm))
    for first in range(0, len(places_mm), _BLOCK):
        part = slice(first, first + _BLOCK)
        ways = np.einsum("rk,nkx->nrx", local, _frames(normals[part])).reshape(-1, 3)
        starts = np.repeat(places_mm[part] + off_mm * normals[part], RAYS, axis=0)
        is_blocked = mesh.blocked_along(starts.astype(np.float32), ways.astype(np.float32))
        shares[part] = 1.0 - is_blocked.reshape(-1, RAYS).mean(axis=1)
    return shares


def _cosine_ways(count: int) -> Floats:
    """[count, 3] directions around z, with a density proportional to their cosine: Vogel's spiral on the disk,
    lifted (Malley)."""
    number = np.arange(count) + 0.5
    radius, angle = np.sqrt(number / count), number * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1)


def _frames(normals: Floats) -> Floats:
    """[n, 3, 3] rows: two tangents and the normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    along = np.cross(helper, normals)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    return np.stack([along, np.cross(normals, along), normals], axis=1)

"""Surfaces of the simulated scene: triangles, and the reflection of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Lambert and GGX with Schlick's Fresnel, per channel of the camera after normalisation by Spectralon.

    f = diffuse / pi + D G F / (4 n.l n.v), with F = f0 + (1 - f0)(1 - h.v)^5; without the specular part if the
    roughness is 0.
    """

    name: str
    diffuse: Rgb
    """Red, green, blue reflectance of the diffuse part, 0 to 1."""
    f0: Rgb = (0.0, 0.0, 0.0)
    """Reflectance at normal incidence of the specular part."""
    roughness: float = 0.0
    """GGX alpha (Walter et al. 2007)."""


@dataclass(frozen=True)
class Surface:
    """Triangles of one thing in its own frame, mm."""

    corners_mm: NDArray[np.float64]
    """[triangles, 3, 3]; counter-clockwise seen from outside."""
    materials: tuple[Material, ...]
    material: NDArray[np.int32]
    """[triangles] index into `materials`."""
    tint: NDArray[np.float32] | None = None
    """[triangles, 3] factor of the diffuse reflectance (a texture); None: 1."""
    normals: NDArray[np.float64] | None = None
    """[triangles, 3] unit normals for shading instead of the flat ones (normal detail)."""

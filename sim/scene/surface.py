"""What the simulated world's things are made of: triangles, and how each of them reflects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Lambert and GGX with Schlick's Fresnel, per channel of the camera after normalisation by Spectralon.

    f = diffuse / pi + D G F / (4 n.l n.v), with F = f0 + (1 - f0)(1 - h.v)^5; a roughness of 0 leaves the
    specular part away.
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
    """One thing's triangles in its own frame, mm."""

    corners_mm: NDArray[np.float64]
    """[triangles, 3, 3]; counter-clockwise seen from outside."""
    materials: tuple[Material, ...]
    material: NDArray[np.int32]
    """[triangles] index into `materials`."""
    tint: NDArray[np.float32] | None = None
    """[triangles, 3] factor of the diffuse reflectance (a texture); none means 1."""
    normals: NDArray[np.float64] | None = None
    """[triangles, 3] unit normals used for shading in place of the flat ones (normal detail)."""

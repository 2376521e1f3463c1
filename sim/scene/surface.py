"""Surfaces of the simulated scene: triangles, and the reflection of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

Rgb = tuple[float, float, float]


class Layer(BaseModel):
    """Detail of a surface that is finer than its triangles: a field of waves through space, cut by the surface.

    They are `WAVES` plane waves of one period, in evenly distributed directions with random phases. Their mean
    scales the diffuse reflectance (a texture). Their sum is also a height. Its slope turns the normals, which
    gives bumps, or, with a long period, normals that deviate from the mesh. Heights cast no shadows.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    WAVES: ClassVar[int] = 8

    period_mm: Annotated[float, Field(gt=0)]
    """The finest period on the surface. Waves that meet the surface at an angle are longer there."""
    texture: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Greatest relative change of the diffuse reflectance; its root mean square is a quarter of it."""
    slope_deg: Annotated[float, Field(ge=0, le=45)] = 0.0
    """Root mean square of the slope, as a tangent."""
    seed: Annotated[int, Field(ge=0)] = 1
    along: tuple[float, float, float] | None = None
    """Direction, in the object's frame, of a single wave instead of `WAVES`: a pattern of lines. The root mean
    square of its texture is seven tenths of the greatest change."""

    def waves(self) -> NDArray[np.float64]:
        """[n, 6] wave vector, rad/mm, phase, amplitude of the texture, amplitude of the height, mm; n is `WAVES`,
        or 1 for lines."""
        from scipy.spatial.transform import Rotation

        random = np.random.default_rng((self.seed, self.WAVES))
        per_mm = 2.0 * np.pi / self.period_mm
        if self.along is not None:
            way = np.array(self.along) / np.linalg.norm(self.along)
            height_mm = np.sqrt(2.0) * np.tan(np.radians(self.slope_deg)) / per_mm
            return np.array([[*(per_mm * way), random.uniform(0.0, 2.0 * np.pi), self.texture, height_mm]])
        # Half a Fibonacci sphere: a wave and its opposite are the same.
        height = (np.arange(self.WAVES) + 0.5) / self.WAVES
        angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(self.WAVES)
        ring = np.sqrt(1.0 - height * height)
        ways = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
        ways = Rotation.from_quat(random.standard_normal(4)).apply(ways)
        # The slope's square is half of the amplitudes' squares times per_mm^2, two thirds of it along the surface.
        height_mm = np.tan(np.radians(self.slope_deg)) / per_mm / np.sqrt(self.WAVES / 3.0)
        phases = random.uniform(0.0, 2.0 * np.pi, (self.WAVES, 1))
        amplitudes = np.tile([self.texture / self.WAVES, height_mm], (self.WAVES, 1))
        return np.concatenate([per_mm * ways, phases, amplitudes], axis=1)


@dataclass(frozen=True)
class Material:
    """Lambert and GGX with Schlick's Fresnel, per channel of the camera after normalisation by Spectralon.

    f = diffuse / pi + D G F / (4 n.l n.v), with F = f0 + (1 - f0)(1 - h.v)^5. If the roughness is 0, there is no
    specular part. With a table, f comes from the table, and `diffuse` counts only for light from surface to
    surface.
    """

    name: str
    diffuse: Rgb
    """Red, green, blue reflectance of the diffuse part, 0 to 1."""
    f0: Rgb = (0.0, 0.0, 0.0)
    """Reflectance at normal incidence of the specular part."""
    roughness: float = 0.0
    """GGX alpha (Walter et al. 2007)."""
    detail: tuple[Layer, ...] = ()
    """Detail that is finer than triangles. It is seen only if each pixel is shaded."""
    table: NDArray[np.float32] | None = None
    """[theta_h, theta_d, phi_d, 3] as in `sim.scene.brdf_table`, for materials of any other form."""


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

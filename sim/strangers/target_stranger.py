"""Targets that differ from their description: a bent board, a white tile with a lobe and a stain."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sim.scene.surface import Surface


class TargetStranger(BaseModel):
    """Deviations of `charuco_board` and `spectralon_tile` among the rig's things."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    board_bend_um: float = 0.0
    """Rise of a ChArUco board's middle above its ends, as a cylinder."""
    board_bend_deg: float = 0.0
    """Direction in which it is bent: from its x towards its y."""
    tile_lobe: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Reflectance at normal incidence of a glossy part of the white tile."""
    tile_lobe_roughness: Annotated[float, Field(gt=0, le=1)] = 0.35
    tile_stain: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the light that a stain on the white tile takes at its middle."""
    tile_stain_mm: Annotated[float, Field(gt=0)] = 8.0
    """Radius at which the stain lowers the reflectance by 0.6 times its depth. The stain's middle is at this
    distance along x from the tile's middle.
    """

    def disturbed_surface(self, kind: str, surface: Surface) -> Surface:
        if kind == "charuco_board" and self.board_bend_um:
            return self._bend(surface)
        if kind == "spectralon_tile":
            return self._stain(self._glossy(surface))
        return surface

    def _bend(self, surface: Surface) -> Surface:
        corners = surface.corners_mm.copy()
        top = corners[..., 2].max()
        direction = np.radians(self.board_bend_deg)
        along = corners[..., 0] * np.cos(direction) + corners[..., 1] * np.sin(direction)
        rise = 1e-3 * self.board_bend_um * (1.0 - (along / np.abs(along).max()) ** 2)
        corners[..., 2] += np.where(corners[..., 2] > 0.5 * top, rise, 0.0)
        return replace(surface, corners_mm=corners)

    def _glossy(self, surface: Surface) -> Surface:
        if not self.tile_lobe:
            return surface
        f0 = (self.tile_lobe, self.tile_lobe, self.tile_lobe)
        materials = tuple(
            replace(material, f0=f0, roughness=self.tile_lobe_roughness) for material in surface.materials
        )
        return replace(surface, materials=materials)

    def _stain(self, surface: Surface) -> Surface:
        if not self.tile_stain:
            return surface
        middle = surface.corners_mm.mean(axis=1)
        away2 = (middle[:, 0] - self.tile_stain_mm) ** 2 + middle[:, 1] ** 2
        clean = 1.0 - self.tile_stain * np.exp(-0.5 * away2 / self.tile_stain_mm**2)
        return replace(surface, tint=np.repeat(clean[:, None], 3, axis=1).astype(np.float32))

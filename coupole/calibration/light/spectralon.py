"""Reflectance of a Spectralon tile, as a function of directions, with an uncertainty.

Minnaert's law (Astrophysical Journal 93, 1941): f = rho (k + 1) / (2 pi) (cos_i cos_o)^(k - 1). It is reciprocal,
k = 1 is Lambert's law, and for light along the normal the hemispherical reflectance is rho. For real Spectralon k
is above 1: a comprehensive model from goniometer data (IEEE TGRS 2024, doi 10.1109/TGRS.2024.3361392) has a
diffuse part that falls with the zenith angle z in radians by 0.091 z^1.85, which k = 1.15 follows within 1 % to 60
degrees; `u_minnaert` has to cover its lobes, forward and back. Figures of a goniometer's certificate for the tile
belong into the description.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from coupole.calibration.rotations import Floats
from coupole.plan import yamlfile
from coupole.plan.base_model import Model, Pose


class Tile(Model):
    """A white tile and its pose; its white face is z = 0 of its frame, with the origin in the centre."""

    schema_version: Literal[1] = 1
    name: str = "Spectralon SRS-99"
    reflectance: Annotated[float, Field(gt=0, le=1.05)] = 0.99
    """Hemispherical, for light along the normal."""
    u_reflectance: Annotated[float, Field(ge=0)] = 0.005
    minnaert: Annotated[float, Field(ge=0.5, le=1.5)] = 1.15
    u_minnaert: Annotated[float, Field(ge=0)] = 0.05
    side_mm: Annotated[float, Field(gt=0)] = 50.0
    margin_mm: Annotated[float, Field(ge=0)] = 5.0
    """Width of the rim that is not used."""
    support_from_tile: Pose = Pose(translation_mm=(0.0, 0.0, 10.0))
    u_tilt_deg: Annotated[float, Field(gt=0)] = 0.1
    """Standard uncertainty of the tilt of the tile's normal in the pose above, about each of two axes."""
    u_height_mm: Annotated[float, Field(gt=0)] = 0.5
    """Standard uncertainty of the white face's place along its normal; shifts within the face do not change the
    image."""

    def brdf(self, cos_in: Floats, cos_out: Floats, *, minnaert: float | None = None) -> Floats:
        """f in 1/sr, for cosines of incidence and observation above 0."""
        k = self.minnaert if minnaert is None else minnaert
        cos_product = np.maximum(cos_in * cos_out, 1e-12)
        value: Floats = self.reflectance * (k + 1.0) / (2.0 * np.pi) * cos_product ** (k - 1.0)
        return value


def read_tile(path: Path) -> Tile:
    """A tile's description (YAML). Raises InputError with all problems."""
    return yamlfile.read_document(path).validate(Tile)

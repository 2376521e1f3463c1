"""Reflectance of a Spectralon tile, as a function of directions, with an uncertainty.

Minnaert's law (Astrophysical Journal 93, 1941): f = rho (k + 1) / (2 pi) (cos_i cos_o)^(k - 1). It is reciprocal.
k = 1 gives Lambert's law, and for light along the normal the hemispherical reflectance is rho. For real Spectralon
k is above 1. A comprehensive model from goniometer data (IEEE TGRS 2024, doi 10.1109/TGRS.2024.3361392) has a
diffuse part that falls with the zenith angle z in radians by 0.091 z^1.85. k = 1.15 follows this within 1 % up to
60 degrees. `u_minnaert` must cover its forward and backward lobes. If the tile has a goniometer's certificate,
write its figures into the description.

A certificate states a reflectance in some geometry. rho follows from it by the law itself. Light at the angle i
gives rho cos_i^(k - 1) over the hemisphere, so 8/h is rho cos(8 deg)^(k - 1). 0/45 over a perfect diffuser is rho
(k + 1) / 2 cos(45 deg)^(k - 1). So if the certificate's figure is held, k changes rho.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from coupole.calibration.artefact import Described, Geometry, LightSpectrum, read_described
from coupole.calibration.rotations import Floats
from coupole.plan.base_model import Pose


class Tile(Described):
    """A white tile and its pose. Its white face is z = 0 of its frame, and the origin is in the centre."""

    schema_version: Literal[1] = 1
    name: str = "Spectralon SRS-99"
    reflectance: Annotated[float, Field(gt=0, le=1.05)] = 0.99
    """Reflectance in `geometry`. Leave both out if `artefact` has a certified `reflectance`."""
    u_reflectance: Annotated[float, Field(ge=0)] = 0.005
    geometry: Geometry = "0/h"
    """Light and view of `reflectance`: 0/h is hemispherical, for light along the normal."""
    minnaert: Annotated[float, Field(ge=0.5, le=1.5)] = 1.15
    u_minnaert: Annotated[float, Field(ge=0)] = 0.05
    side_mm: Annotated[float, Field(gt=0)] = 50.0
    margin_mm: Annotated[float, Field(ge=0)] = 5.0
    """Width of the rim that is not used."""
    support_from_tile: Pose = Pose(translation_mm=(0.0, 0.0, 10.0))
    u_tilt_deg: Annotated[float, Field(gt=0)] = 0.1
    """Standard uncertainty of the direction of the tile's normal in the pose above, about each of two axes."""
    u_height_mm: Annotated[float, Field(gt=0)] = 0.5
    """Standard uncertainty of the white face's place along its normal. Shifts within the face do not change the
    image."""

    @model_validator(mode="after")
    def _certificate_alone(self) -> Self:
        if self.artefact is None or self.artefact.reflectance is None:
            return self
        if doubled_keys := sorted({"reflectance", "u_reflectance", "geometry"} & self.model_fields_set):
            raise ValueError(f"no {', '.join(doubled_keys)} beside a certified artefact.reflectance")
        return self

    def of_channel(self, channel: str, light: LightSpectrum | None = None) -> Tile:
        """Return the tile as a channel of the camera sees it under this light, with its certificate's mean there.
        Without a certified reflectance it is the same tile. Raises InputError for a band without certified
        values."""
        if self.artefact is None or self.artefact.reflectance is None:
            return self
        value, u = self.artefact.reflectance.in_channel(channel, light)
        changes = {"reflectance": value, "u_reflectance": u, "geometry": self.artefact.reflectance.geometry}
        return self.model_copy(update=changes)

    def hemispherical(self, minnaert: float) -> float:
        """Return rho for light along the normal, for this k of Minnaert's law."""
        match self.geometry:
            case "0/h":
                return self.reflectance
            case "8/h":
                return float(self.reflectance / np.cos(np.radians(8.0)) ** (minnaert - 1.0))
            case "0/45":
                return float(self.reflectance / (0.5 * (minnaert + 1.0) * np.sqrt(0.5) ** (minnaert - 1.0)))

    def brdf(self, cos_in: Floats, cos_out: Floats, *, minnaert: float | None = None) -> Floats:
        """Return f in 1/sr, for cosines of incidence and observation above 0."""
        k = self.minnaert if minnaert is None else minnaert
        cos_product = np.maximum(cos_in * cos_out, 1e-12)
        value: Floats = self.hemispherical(k) * (k + 1.0) / (2.0 * np.pi) * cos_product ** (k - 1.0)
        return value


def read_tile(path: Path) -> Tile:
    """Read a tile's description (YAML). Raises InputError with all problems."""
    return read_described(path, Tile)

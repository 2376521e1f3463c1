"""The dome's flat white panels: they light the scene, and may be visible to the camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from coupole.geometry import Transform
from sim.render.emitter import Emitter, irradiance

PARTS = 4
"""A panel is computed as PARTS x PARTS pieces, each with its own shadow, which gives soft shadows."""
_Vector = tuple[float, float, float]
_Length = Annotated[float, Field(gt=0)]


class Panel(BaseModel):
    """One square panel, in the support frame. Its upper edge is horizontal."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    centre_mm: _Vector
    towards_mm: _Vector = (0.0, 0.0, 0.0)
    """A point that the panel faces."""
    side_mm: _Length = 600.0
    unevenness: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Relative decrease of luminance (a paraboloid) from its centre to the middle of its edges."""


def whole(panel: Panel, base_from_support: Transform, lux: float) -> Emitter:
    """Return the panel in the base frame as if it were uniform. The flux is pi times the area times the luminance
    of its centre. It gives `lux` on a horizontal surface at the support's centre."""
    one_lumen = _one_lumen(panel, base_from_support)
    lux_of_one_lumen = sum(
        float(irradiance(piece, base_from_support[:3, 3], base_from_support[:3, 2])[0])
        for piece in pieces(one_lumen, panel.unevenness)
    )
    return replace(one_lumen, flux_lm=lux / lux_of_one_lumen if lux_of_one_lumen > 0.0 else 0.0)


def pieces(panel: Emitter, unevenness: float) -> list[Emitter]:
    """PARTS x PARTS squares that make up a panel."""
    places = (2.0 * np.arange(PARTS) + 1.0) / PARTS - 1.0
    return [
        Emitter(
            panel.centre_mm + u * panel.half_u_mm + v * panel.half_v_mm,
            panel.normal,
            panel.half_u_mm / PARTS,
            panel.half_v_mm / PARTS,
            panel.flux_lm / PARTS**2 * (1.0 - unevenness * (u * u + v * v)),
        )
        for u in places
        for v in places
    ]


def _one_lumen(panel: Panel, base_from_support: Transform) -> Emitter:
    centre = np.array(panel.centre_mm)
    normal = np.array(panel.towards_mm) - centre
    normal /= np.linalg.norm(normal)
    rotation = base_from_support[:3, :3]
    level = np.cross((0.0, 0.0, 1.0), normal)
    length = np.linalg.norm(level)
    level = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])  # the panel faces straight up or down
    half_mm = 0.5 * panel.side_mm
    return Emitter(
        rotation @ centre + base_from_support[:3, 3],
        rotation @ normal,
        half_mm * (rotation @ level),
        half_mm * (rotation @ np.cross(normal, level)),
        1.0,
    )

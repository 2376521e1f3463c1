"""Materials that an object may have, supposed before anything is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SupposedMaterial:
    """Lambert plus GGX as in `coupole.reflectance.ggx`, the same in all channels."""

    kd: float
    """Diffuse reflectance kd, 1/sr."""
    ks: float
    alpha: float


SUPPOSED = {
    "matt": SupposedMaterial(0.4 / math.pi, 0.04, 0.6),
    "glossy": SupposedMaterial(0.2 / math.pi, 0.04, 0.15),
    "metal": SupposedMaterial(0.05 / math.pi, 0.7, 0.25),
}
"""Limestone or unglazed clay; a varnished or lacquered surface; gilt or polished metal, a little
worn."""
UNKNOWN = "unknown"
"""Name for any of these materials."""


def supposed_materials(name: str) -> dict[str, SupposedMaterial]:
    """Return the materials, by name, for which a plan must be suitable."""
    return SUPPOSED if name == UNKNOWN else {name: SUPPOSED[name]}

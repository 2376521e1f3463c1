"""Materials that an object may be of before anything of it is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SupposedMaterial:
    """Lambert plus GGX as in `coupole.reflectance.ggx`, the same in all channels."""

    kd: float
    """1/sr"""
    ks: float
    alpha: float


SUPPOSED = {
    "matt": SupposedMaterial(0.4 / math.pi, 0.04, 0.6),
    "glossy": SupposedMaterial(0.2 / math.pi, 0.04, 0.15),
    "metal": SupposedMaterial(0.05 / math.pi, 0.7, 0.25),
}
"""Limestone or unglazed clay; varnished or lacquered; gilt or polished metal, a little worn."""
UNKNOWN = "unknown"
"""Any of them."""


def supposed_materials(name: str) -> dict[str, SupposedMaterial]:
    """The materials, by name, that a plan must serve."""
    return SUPPOSED if name == UNKNOWN else {name: SUPPOSED[name]}

"""Samples in steps: gold leaf of rising thickness, and a paint of rising thickness over black and white."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim.objects import appearance
from sim.objects.patchwork import Array, joined, of_material, rectangle, skirt
from sim.scene.surface import Material, Surface

GILT_NM = (0.0, 10.0, 20.0, 40.0, 70.0, 100.0, 150.0, 250.0)
"""From bare bole to bulk gold; a beaten leaf has some 100 nm."""
PAINT_MM = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32)


def gilt_step_wedge(
    thicknesses_nm: Sequence[float] = GILT_NM,
    *,
    step_mm: float = 15.0,
    depth_mm: float = 30.0,
    roughness: float = 0.12,
) -> Surface:
    """A panel that stands on z = 0: along x, gold leaf of these thicknesses on bole (seed 001, section 5)."""
    fields = [[appearance.gilt(thickness, roughness=roughness) for thickness in thicknesses_nm]]
    return _panel(fields, step_mm, depth_mm)


def paint_wedge(
    pigment: str = "azurite",
    thicknesses_mm: Sequence[float] = PAINT_MM,
    *,
    step_mm: float = 15.0,
    row_mm: float = 20.0,
    scattering_per_mm: float = 8.0,
) -> Surface:
    """A panel that stands on z = 0: along x, a paint of these thicknesses; towards +y over white, else over black.

    The grounds reflect 90 % and 2 % inside the binder, as the halves of a drawdown card; coarse blue pigments
    scatter little (all assumed).
    """
    fields = [
        [
            appearance.paint(pigment, thickness_mm=h, ground=ground, scattering_per_mm=scattering_per_mm)
            for h in thicknesses_mm
        ]
        for ground in (0.02, 0.90)
    ]
    return _panel(fields, step_mm, row_mm)


def _panel(fields: Sequence[Sequence[Material]], step_mm: float, row_mm: float, body_mm: float = 8.0) -> Surface:
    """A plate whose top is divided into fields: rows along y, steps along x, z = `body_mm`."""
    rows, steps = len(fields), len(fields[0])
    parts = []
    for row, materials in enumerate(fields):
        for step, material in enumerate(materials):
            middle = [(step - (steps - 1) / 2) * step_mm, (row - (rows - 1) / 2) * row_mm, body_mm]
            parts.append(of_material(rectangle(step_mm, row_mm) + np.array(middle), material))
    lid: Array = np.concatenate([part.corners_mm for part in parts])
    return joined([*parts, of_material(skirt(lid), appearance.BLACK_PRINT)])

"""Step samples: gold leaf of increasing thickness, and a paint of increasing thickness over black and white."""

from __future__ import annotations

from collections.abc import Sequence

from coupole.appearance.shapes.samples import GILT_NM, PAINT_MM, stepped_panel
from sim.objects import appearance
from sim.objects.surfaces import joined_surface, of_material
from sim.scene.surface import Material, Surface


def gilt_step_wedge(
    thicknesses_nm: Sequence[float] = GILT_NM,
    *,
    step_mm: float = 15.0,
    depth_mm: float = 30.0,
    roughness: float = 0.12,
) -> Surface:
    """A panel that stands on z = 0: gold leaf of these thicknesses on bole along x (Callet et al. 2010, 5)."""
    fields = [[appearance.gilt(thickness, roughness=roughness) for thickness in thicknesses_nm]]
    return _panel(fields, step_mm, depth_mm)


def paint_wedge(
    pigment: str = "blue_one_peak_shape",
    thicknesses_mm: Sequence[float] = PAINT_MM,
    *,
    step_mm: float = 15.0,
    row_mm: float = 20.0,
    scattering_per_mm: float = 8.0,
) -> Surface:
    """A panel standing on z = 0: along x, a paint of these thicknesses; towards +y over white, else over black.

    The grounds reflect 90 % and 2 % inside the binder, like the halves of a drawdown card; coarse blue pigments
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


def _panel(fields: Sequence[Sequence[Material]], step_mm: float, row_mm: float) -> Surface:
    """Return a panel of fields. Its rows follow each other along y, and its steps along x."""
    panel = stepped_panel(len(fields), len(fields[0]), step_mm, row_mm)
    materials = [material for row in fields for material in row]
    parts = [of_material(corners, material) for corners, material in zip(panel.fields, materials, strict=True)]
    return joined_surface([*parts, of_material(panel.body, appearance.BLACK_PRINT)])

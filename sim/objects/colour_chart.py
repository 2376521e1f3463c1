"""A colour chart of 24 patches. Its spectra are drawn, not measured; they belong to no maker's chart.

Each spectrum is a floor, edges (steps as in yellows, oranges, reds) and bands (as in blues and greens) over
wavelength. The last row is nearly grey. `configs/charts/drawn-24.txt` lists the same spectra for `coupole
calibrate colour`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.shapes.triangles import rectangle, skirt
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from sim.objects import appearance
from sim.objects.surfaces import joined_surface, of_material
from sim.scene.surface import Material, Surface

ROWS, COLUMNS = 4, 6
PITCH_MM, PATCH_MM, MARGIN_MM = 22.0, 18.0, 6.0
THICKNESS_MM = 2.0
_CELL_MM = 2.0
"""Size of the cells of the face; edges of patches and plate lie on multiples of it."""


@dataclass(frozen=True)
class Drawn:
    """A reflectance over wavelength."""

    floor: float
    edges: tuple[tuple[float, float, float], ...] = ()
    """Height, wavelength of half height in nm, width in nm. It reflects above this wavelength, or below if the
    height is negative."""
    bands: tuple[tuple[float, float, float], ...] = ()
    """height, centre in nm, standard deviation in nm."""

    def at(self, wavelengths_nm: Array) -> Array:
        """Reflectance [n] at wavelengths [n]."""
        value = np.full_like(wavelengths_nm, self.floor)
        for height, half_nm, width_nm in self.edges:
            value = value + height / (1.0 + np.exp((half_nm - wavelengths_nm) / width_nm))
        for height, centre_nm, spread_nm in self.bands:
            value = value + height * np.exp(-0.5 * ((wavelengths_nm - centre_nm) / spread_nm) ** 2)
        return np.asarray(value)


DRAWN = {
    "A1": Drawn(0.05, ((0.16, 605.0, 22.0),), ((0.05, 520.0, 60.0),)),
    "A2": Drawn(0.17, ((0.42, 588.0, 16.0),), ((0.09, 470.0, 45.0),)),
    "A3": Drawn(0.15, ((0.08, 690.0, 14.0),), ((0.22, 460.0, 48.0),)),
    "A4": Drawn(0.05, ((0.10, 700.0, 18.0),), ((0.15, 550.0, 32.0),)),
    "A5": Drawn(0.20, ((0.25, 660.0, 28.0),), ((0.28, 445.0, 42.0),)),
    "A6": Drawn(0.16, ((0.10, 705.0, 20.0),), ((0.43, 510.0, 46.0),)),
    "B1": Drawn(0.05, ((0.55, 582.0, 15.0),)),
    "B2": Drawn(0.06, ((0.16, 690.0, 15.0),), ((0.32, 448.0, 34.0),)),
    "B3": Drawn(0.10, ((0.46, 597.0, 13.0),), ((0.05, 430.0, 40.0),)),
    "B4": Drawn(0.05, ((0.20, 660.0, 22.0),), ((0.13, 440.0, 30.0),)),
    "B5": Drawn(0.06, ((0.50, 516.0, 12.0), (-0.28, 595.0, 26.0))),
    "B6": Drawn(0.06, ((0.66, 558.0, 15.0),)),
    "C1": Drawn(0.04, ((0.08, 710.0, 16.0),), ((0.28, 452.0, 26.0),)),
    "C2": Drawn(0.05, ((0.10, 705.0, 18.0),), ((0.30, 528.0, 28.0),)),
    "C3": Drawn(0.045, ((0.62, 612.0, 11.0),)),
    "C4": Drawn(0.05, ((0.74, 512.0, 13.0),)),
    "C5": Drawn(0.12, ((0.55, 606.0, 15.0),), ((0.25, 442.0, 36.0),)),
    "C6": Drawn(0.07, ((0.08, 710.0, 18.0),), ((0.36, 478.0, 38.0),)),
    "D1": Drawn(0.88, ((0.012, 470.0, 40.0),)),
    "D2": Drawn(0.58, ((0.010, 560.0, 60.0),)),
    "D3": Drawn(0.36, ((-0.006, 600.0, 60.0),)),
    "D4": Drawn(0.19, ((0.004, 520.0, 50.0),)),
    "D5": Drawn(0.088, ((-0.002, 560.0, 60.0),)),
    "D6": Drawn(
        0.032,
    ),
}
"""Patches by name: rows A to D from the top, columns 1 to 6 from the left."""


def colour_chart() -> Surface:
    """Return a plate that stands on z = 0, with its face at z = `THICKNESS_MM`: matt patches on black. The origin
    is below the middle of the patches; x runs along the rows, y up."""
    width_mm = COLUMNS * PITCH_MM + 2.0 * MARGIN_MM
    depth_mm = ROWS * PITCH_MM + 2.0 * MARGIN_MM
    cells = (round(width_mm / _CELL_MM), round(depth_mm / _CELL_MM))
    face = rectangle(width_mm, depth_mm, *cells, z_mm=THICKNESS_MM)
    parts = [of_material(skirt(face), appearance.BLACK_PRINT)]
    black = np.ones(len(face), bool)
    x_mm, y_mm = face.mean(axis=1)[:, :2].T
    for name, spectrum in DRAWN.items():
        row, column = ord(name[0]) - ord("A"), int(name[1]) - 1
        off_x_mm = x_mm - (column - (COLUMNS - 1) / 2.0) * PITCH_MM
        off_y_mm = y_mm - ((ROWS - 1) / 2.0 - row) * PITCH_MM
        patch = np.maximum(np.abs(off_x_mm), np.abs(off_y_mm)) < PATCH_MM / 2.0
        black &= ~patch
        parts.append(of_material(face[patch], Material(name, appearance.rgb(spectrum.at(WAVELENGTHS_NM)))))
    return joined_surface([*parts, of_material(face[black], appearance.BLACK_PRINT)])

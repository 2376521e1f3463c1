"""Typical reflectances of the paints that the papers name, as formulas: for virtual objects, not for
identification.

They are not measurements. Each is K/S as a sum of a floor, edges (reds and yellows: absorption below a wavelength)
and bands (blues and greens), placed where the seeds and general knowledge of reflectance spectroscopy put them:
lapis-lazuli reflects about 455 nm and again towards 780 nm, azurite has one peak (seed 000, section 3.5). Use
`measured` for measured spectra.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError


@dataclass(frozen=True)
class Shape:
    """Absorption K/S over wavelength."""

    floor: float
    edges: tuple[tuple[float, float, float], ...] = ()
    """height, wavelength of half height in nm, width in nm: absorbs below."""
    bands: tuple[tuple[float, float, float], ...] = ()
    """height, centre in nm, standard deviation in nm."""


SHAPES: dict[str, Shape] = {
    "white lead": Shape(0.004, edges=((0.15, 370.0, 15.0),)),
    "vine black": Shape(12.0),
    "vermilion": Shape(0.03, edges=((6.0, 590.0, 7.0),)),
    "red lead": Shape(0.03, edges=((5.0, 553.0, 8.0),)),
    "red ochre": Shape(0.35, edges=((5.0, 560.0, 16.0),), bands=((0.15, 660.0, 40.0),)),
    "yellow ochre": Shape(0.15, edges=((3.5, 500.0, 18.0),), bands=((0.12, 650.0, 40.0),)),
    "azurite": Shape(0.25, edges=((0.8, 385.0, 18.0),), bands=((6.0, 650.0, 85.0),)),
    "lapis-lazuli": Shape(0.20, edges=((0.9, 385.0, 18.0),), bands=((7.0, 600.0, 55.0),)),
    "malachite": Shape(0.30, edges=((2.5, 425.0, 22.0),), bands=((4.5, 740.0, 95.0),)),
    "green earth": Shape(1.0, edges=((1.5, 450.0, 25.0),), bands=((1.2, 700.0, 80.0),)),
}


def reflectance(name: str) -> Array:
    """Typical reflectance [81] of an opaque layer, inside its binder."""
    if name not in SHAPES:
        raise InputError(f"pigment: expected one of {', '.join(SHAPES)}; found {name!r}; choose one of them")
    shape, nm = SHAPES[name], WAVELENGTHS_NM
    k_over_s = np.full_like(nm, shape.floor)
    for height, half_nm, width_nm in shape.edges:
        k_over_s += height / (1.0 + np.exp((nm - half_nm) / width_nm))
    for height, centre_nm, deviation_nm in shape.bands:
        k_over_s += height * np.exp(-0.5 * ((nm - centre_nm) / deviation_nm) ** 2)
    return kubelka_munk.opaque(k_over_s)


def bole() -> Array:
    """The papers' bole: equal parts of red lead and red ochre (seed 001, section 5), by K/S of equal
    scattering."""
    halves = [kubelka_munk.k_over_s(reflectance(name)) for name in ("red lead", "red ochre")]
    return kubelka_munk.opaque(0.5 * (halves[0] + halves[1]))

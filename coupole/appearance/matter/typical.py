"""Assumed shapes of reflectance spectra, as formulas: for virtual objects, not for identification.

They are no measurements, and no pigments: the shape that was once called azurite scores 0.62 against a measured
azurite. Each is K/S as a sum of a floor, edges (reds and yellows: absorption below a wavelength) and bands (blues
and greens). Their wavelengths follow the seeds and general knowledge of reflectance spectroscopy for paints of
such a colour. Use `measured` for measured spectra, `paint_file` for measured K and S.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError


@dataclass(frozen=True)
class Shape:
    """Absorption K/S over wavelength."""

    floor: float
    edges: tuple[tuple[float, float, float], ...] = ()
    """Height, wavelength of half height in nm, width in nm; the edge absorbs below this wavelength."""
    bands: tuple[tuple[float, float, float], ...] = ()
    """Height, centre in nm, standard deviation in nm."""


SHAPES: dict[str, Shape] = {
    "white_shape": Shape(0.004, edges=((0.15, 370.0, 15.0),)),
    "black_shape": Shape(12.0),
    "red_shape": Shape(0.03, edges=((6.0, 590.0, 7.0),)),
    "orange_shape": Shape(0.03, edges=((5.0, 553.0, 8.0),)),
    "dull_red_shape": Shape(0.35, edges=((5.0, 560.0, 16.0),), bands=((0.15, 660.0, 40.0),)),
    "dull_yellow_shape": Shape(0.15, edges=((3.5, 500.0, 18.0),), bands=((0.12, 650.0, 40.0),)),
    "blue_one_peak_shape": Shape(0.25, edges=((0.8, 385.0, 18.0),), bands=((6.0, 650.0, 85.0),)),
    "blue_two_peaks_shape": Shape(0.20, edges=((0.9, 385.0, 18.0),), bands=((7.0, 600.0, 55.0),)),
    "green_shape": Shape(0.30, edges=((2.5, 425.0, 22.0),), bands=((4.5, 740.0, 95.0),)),
    "dull_green_shape": Shape(1.0, edges=((1.5, 450.0, 25.0),), bands=((1.2, 700.0, 80.0),)),
}


FORMER_NAMES = {
    "white lead": "white_shape",
    "vine black": "black_shape",
    "vermilion": "red_shape",
    "red lead": "orange_shape",
    "red ochre": "dull_red_shape",
    "yellow ochre": "dull_yellow_shape",
    "azurite": "blue_one_peak_shape",
    "lapis-lazuli": "blue_two_peaks_shape",
    "malachite": "green_shape",
    "green earth": "dull_green_shape",
}
"""Former names of these shapes, which were names of pigments; scene files may still use them."""


def reflectance(name: str) -> InternalReflectance:
    """Return the assumed reflectance [81] of an opaque layer, inside its binder; a former name is accepted."""
    shape = SHAPES.get(FORMER_NAMES.get(name, name))
    if shape is None:
        raise InputError(f"shape: expected one of {', '.join(SHAPES)}; found {name!r}; choose one of them")
    nm = WAVELENGTHS_NM
    k_over_s = np.full_like(nm, shape.floor)
    for height, half_nm, width_nm in shape.edges:
        k_over_s += height / (1.0 + np.exp((nm - half_nm) / width_nm))
    for height, centre_nm, deviation_nm in shape.bands:
        k_over_s += height * np.exp(-0.5 * ((nm - centre_nm) / deviation_nm) ** 2)
    return InternalReflectance(kubelka_munk.opaque(k_over_s))


def bole() -> InternalReflectance:
    """Return the papers' bole, equal parts of red lead and red ochre (Callet et al. 2010, section 5), inside its
    binder. It is mixed from the assumed shapes of these colours, by K/S with equal scattering."""
    halves = [kubelka_munk.k_over_s(reflectance(name).values) for name in ("orange_shape", "dull_red_shape")]
    return InternalReflectance(kubelka_munk.opaque(0.5 * (halves[0] + halves[1])))

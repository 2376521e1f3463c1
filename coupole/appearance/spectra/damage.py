"""Radiant exposure weighted by damage (CIE 157:2004), from the light's spectrum.

The relative spectral responsivity to damage is s(lambda) = exp(-b (lambda - 300 nm)) (CIE 157:2004, Eq. 2.5).
"""

from __future__ import annotations

import numpy as np

from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.appearance.spectra.measured import Measured
from coupole.errors import InputError

B_PER_NM = 0.0115
"""Exponent b by CIE 157:2004, for oil paint on canvas and for water-colours on rag paper."""
COVERED_NM = (400.0, 700.0)
"""Range that a spectrum must cover, so that neither damage nor light is left out."""
LM_PER_W = 683.0
"""Luminous efficacy at 555 nm (CIE 18)."""
# fmt: off
_V = (
    3.9e-05, 6.4e-05, 0.00012, 0.000217, 0.000396, 0.00064, 0.00121, 0.00218, 0.004, 0.0073, 0.0116, 0.01684,
    0.023, 0.0298, 0.038, 0.048, 0.06, 0.0739, 0.09098, 0.1126, 0.13902, 0.1693, 0.20802, 0.2586, 0.323, 0.4073,
    0.503, 0.6082, 0.71, 0.7932, 0.862, 0.91485, 0.954, 0.9803, 0.99495, 1.0, 0.995, 0.9786, 0.952, 0.9154,
    0.87, 0.8163, 0.757, 0.6949, 0.631, 0.5668, 0.503, 0.4412, 0.381, 0.321, 0.265, 0.217, 0.175, 0.1382, 0.107,
    0.0816, 0.061, 0.04458, 0.032, 0.0232, 0.017, 0.01192, 0.00821, 0.005723, 0.004102, 0.002929, 0.002091,
    0.001484, 0.001047, 0.00074, 0.00052, 0.0003611, 0.0002492, 0.0001719, 0.00012, 8.48e-05, 6e-05, 4.24e-05,
    3e-05, 2.12e-05, 1.499e-05,
)
# fmt: on
"""V(lambda), photopic luminous efficiency for the 2-degree observer (CIE 1924, ISO/CIE 11664-1), on the grid."""


def damage_w_per_lm(spectrum: Measured) -> float:
    """Return the damaging power of light with this spectrum (relative power against nm), in W for each lumen. Lux
    hours times this number are the radiant exposure weighted by damage, in W h/m2.

    The whole given spectrum is used, including ultraviolet. Raises InputError for a spectrum that does not cover
    `COVERED_NM`, or has no visible light.
    """
    nm, power = spectrum.wavelengths_nm, spectrum.values
    fine_nm = np.arange(nm[0], nm[-1] + 0.5)
    fine = np.interp(fine_nm, nm, power)
    if nm[0] > COVERED_NM[0] or nm[-1] < COVERED_NM[1]:
        raise InputError(
            f"spectrum {spectrum.name}: expected {COVERED_NM[0]:g} to {COVERED_NM[1]:g} nm at least, found "
            f"{nm[0]:g} to {nm[-1]:g}"
        )
    visible_power = float(
        np.trapezoid(fine * np.interp(fine_nm, WAVELENGTHS_NM, _V, left=0.0, right=0.0), fine_nm)
    )
    if visible_power <= 0.0:
        raise InputError(f"spectrum {spectrum.name}: expected visible light, found none")
    damaging = float(np.trapezoid(fine * np.exp(-B_PER_NM * (fine_nm - 300.0)), fine_nm))
    return damaging / (LM_PER_W * visible_power)

"""Effective index of a host with small spheroids in it (Maxwell Garnett 1904; Callet et al. 2010, Eqs 2-5).

For gilts the host is gold, a continuous leaf, and the inclusions are nanoscopic holes filled with egg white; the
reverse describes separate grains of gold. The model is valid for lengths much smaller than the wavelength, and for
shares up to about a third, below percolation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.spectra.grid import Array, Complex, within


def depolarisation_short(flatness: ArrayLike) -> Array:
    """A, the depolarisation factor along the short axis c of an oblate spheroid a = b = `flatness` c (Eqs 2, 3).

    It is 1/3 for a sphere (flatness 1), and tends to 1 for a disk. Below e = 1e-3 the formula loses its digits,
    and the series 1/3 + 2 e^2/15 is used.
    """
    e2 = within("flatness a/c", flatness, 1.0, 1e6) ** 2 - 1.0
    e = np.sqrt(np.maximum(e2, 1e-6))
    return np.where(e2 < 1e-6, 1.0 / 3.0 + 2.0 * e2 / 15.0, (1.0 + e**2) / e**3 * (e - np.arctan(e)))


def depolarisation_in_plane(flatness: ArrayLike) -> Array:
    """The factor along a long axis: (1 - A)/2, since the three factors sum to 1.

    It applies to light along the leaf's normal, which has its electric field in the leaf's plane.
    """
    return 0.5 * (1.0 - depolarisation_short(flatness))


def maxwell_garnett(
    host: ArrayLike, inclusions: ArrayLike, share: ArrayLike, depolarisation: ArrayLike
) -> Complex:
    """Return the effective complex index (Eqs 4, 5) from the indices of host and inclusions; inclusions have the
    `share` of the volume."""
    e_m, e_i = (np.asarray(n, dtype=complex) ** 2 for n in (host, inclusions))
    p, a = within("share of the inclusions", share, 0.0, 1.0), within("depolarisation", depolarisation, 0.0, 1.0)
    effective = (
        e_m
        * (e_i * (a + p * (1.0 - a)) + e_m * (1.0 - p) * (1.0 - a))
        / (e_i * a * (1.0 - p) + e_m * (1.0 - a * (1.0 - p)))
    )
    # A mixture of absorbing media absorbs, so the root with positive real part is the decaying wave; a negative
    # imaginary part is rounding.
    index: Complex = np.sqrt(effective)
    return index.real + 1j * np.abs(index.imag)

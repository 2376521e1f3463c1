"""An equivalent metal for a stack of films, because Mitsuba's rough conductor takes complex indices, but no films.

At each wavelength the equivalent bulk index n + i k has the reflectance of the stack: exactly along the normal,
and as closely as possible at other angles. For a metal leaf it is nearly the leaf's own index. For an interference
film it is not the index of a real substance. If the film's hue depends strongly on the angle, there is no
equivalent.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coupole.appearance.optics import fresnel
from coupole.appearance.spectra.grid import BANDS, Array, Complex
from coupole.errors import InputError

_COSINES: Array = np.cos(np.radians([0.0, 20.0, 35.0, 50.0, 60.0, 70.0, 78.0]))
_TRIED = 400
MOST_OFF = 0.05


def equivalent_index(reflectance: Callable[[Array], Array]) -> Complex:
    """Return n + i k [81] of bulk with the unpolarised reflectance nearest to `reflectance`(cosines) -> [angles,
    81].

    Raises InputError if they differ by more than `MOST_OFF` at some wavelength and angle up to 78 degrees.
    """
    target = reflectance(_COSINES)
    normal = np.clip(target[0], 1e-6, 1.0 - 1e-6)
    # R = ((n-1)^2 + k^2)/((n+1)^2 + k^2) along the normal: k follows from n, between the two n that need no k.
    root = np.sqrt(normal)
    least, most = (1.0 - root) / (1.0 + root), (1.0 + root) / (1.0 - root)
    n = least * (most / least) ** np.linspace(0.0, 1.0, _TRIED)[:, None]
    k = np.sqrt(np.maximum(0.0, (normal * (n + 1.0) ** 2 - (n - 1.0) ** 2) / (1.0 - normal)))
    reflectances = np.stack([fresnel.reflectance(c, n + 1j * k) for c in _COSINES])
    best = np.argmin(np.sum((reflectances - target[:, None, :]) ** 2, axis=0), axis=0)
    off = float(np.abs(reflectances[:, best, np.arange(BANDS)] - target).max())
    if off > MOST_OFF:
        raise InputError(
            f"films: expected a stack that reflects like a bulk material within {MOST_OFF} at all angles; the "
            f"nearest material differs by {off:.2f}. Take thinner films, or fewer films"
        )
    index: Complex = n[best, np.arange(BANDS)] + 1j * k[best, np.arange(BANDS)]
    return index

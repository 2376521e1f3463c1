"""Stacks of thin films: reflectance and transmittance with interference, by the transfer matrix of each layer.

A layer's transfer matrix is applied in the form of Airy's recursion, from the substrate up: r and t below one
layer give r and t below the next layer above it. It is the same algebra as the product of 2x2 matrices (Born and
Wolf, section 1.6; Byrnes, arXiv:1603.02720), but with decaying exponentials only, so that thick metal films do not
cause overflow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.optics import fresnel
from coupole.appearance.spectra.grid import Array, Complex


@dataclass(frozen=True)
class Film:
    """One homogeneous layer."""

    index: Complex
    """[bands], n + i k."""
    thickness_nm: float


def stack_power(
    cos_outside: ArrayLike,
    wavelengths_nm: ArrayLike,
    films: Sequence[Film],
    *,
    outside: ArrayLike = 1.0,
    substrate: ArrayLike = 1.0,
) -> tuple[Array, Array]:
    """Reflectance and transmittance (into the substrate) of unpolarised light.

    `cos_outside` [...] is the cosine in the incident medium, which is transparent; wavelengths, in vacuum, and
    indices are [bands] or scalars. Both results are [..., bands]; the films absorb the rest.
    """
    reflectances, transmittances = zip(
        *(
            _power_ratios(cos_outside, wavelengths_nm, films, outside, substrate, polarisation)
            for polarisation in (0, 1)
        ),
        strict=True,
    )
    return 0.5 * (reflectances[0] + reflectances[1]), 0.5 * (transmittances[0] + transmittances[1])


def _power_ratios(
    cos_outside: ArrayLike,
    wavelengths_nm: ArrayLike,
    films: Sequence[Film],
    outside: ArrayLike,
    substrate: ArrayLike,
    polarisation: int,
) -> tuple[Array, Array]:
    """Return R and T of s (0) or p (1) light."""
    wavelengths = np.atleast_1d(np.asarray(wavelengths_nm, dtype=float))
    cosine = np.asarray(cos_outside, dtype=complex)[..., None]
    media = [np.asarray(n, dtype=complex) for n in (outside, *(film.index for film in films), substrate)]
    cosines = [cosine + 0.0 * wavelengths, *(fresnel.cos_inside(cosine, media[0], n) for n in media[1:])]
    r: Complex = np.zeros(1, dtype=complex)
    t: Complex = np.ones(1, dtype=complex)
    for above in reversed(range(len(media) - 1)):
        pair = fresnel.amplitudes(cosines[above], cosines[above + 1], media[above], media[above + 1])
        r_here, t_here = pair[polarisation], pair[polarisation + 2]
        turn = np.ones(1, dtype=complex)
        if above < len(films):
            phase = 2.0 * np.pi / wavelengths * films[above].thickness_nm * media[above + 1] * cosines[above + 1]
            turn = np.exp(1j * phase)
        back = 1.0 + r_here * r * turn**2
        r, t = (r_here + r * turn**2) / back, t_here * t * turn / back
    # The flux through an interface is proportional to n cos for s light, to n conj(cos) for p light.
    first, last = (
        n * (c if polarisation == 0 else np.conj(c)) for n, c in ((media[0], cosines[0]), (media[-1], cosines[-1]))
    )
    return np.abs(r) ** 2, np.abs(t) ** 2 * (last.real / first.real)

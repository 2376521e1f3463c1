"""One pigment's absorption and scattering (Kubelka and Munk, `kubelka_munk`).

A pigment has absorption K and scattering S [81] per mm at full concentration in its binder. If only opaque samples
were measured, K and S are relative to the scattering of a white, which is enough for opaque paints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.spectra.grid import Array


@dataclass(frozen=True)
class Pigment:
    """Coefficients [bands] per mm, or relative to a white's scattering."""

    name: str
    absorption: Array
    scattering: Array


def from_opaque(name: str, reflectance: InternalReflectance, scattering: ArrayLike = 1.0) -> Pigment:
    """Return a pigment with known relative scattering, from an opaque sample's reflectance [bands]."""
    s = np.broadcast_to(np.asarray(scattering, dtype=float), reflectance.values.shape)
    return Pigment(name, kubelka_munk.k_over_s(reflectance.values) * s, s)


def opaque_reflectance(pigment: Pigment) -> InternalReflectance:
    """R_inf [bands]."""
    return InternalReflectance(kubelka_munk.opaque(pigment.absorption / pigment.scattering))

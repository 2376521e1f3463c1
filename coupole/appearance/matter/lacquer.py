"""Clear lacquer over metal: absorption along the path in and out (Beer and Lambert), refraction at the surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.optics import fresnel, indices
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array, within


def urushi_absorption(at_450_nm_per_mm: float = 6.0, fall_per_nm: float = 0.016) -> Array:
    """Absorption [81] per mm of transparent (suki) urushi: amber, fading exponentially towards the red.

    The shape is the tail of aromatic chromophores; both numbers are assumed, so that 0.1 mm of lacquer looks
    amber. For a measured transmittance use `absorption_from`.
    """
    return at_450_nm_per_mm * np.exp(-fall_per_nm * (WAVELENGTHS_NM - 450.0))


def absorption_from(transmittance: ArrayLike, thickness_mm: float, index: float = indices.URUSHI) -> Array:
    """Return the absorption per mm from the transmittance of a free film with two reflecting surfaces.

    Without interference, T = (1 - F)^2 t/(1 - F^2 t^2), solved for t = exp(-absorption h).
    """
    transmittance_with_faces = within("transmittance", transmittance, 1e-9, 1.0)
    f = float(fresnel.reflectance(1.0, index))
    inside = (
        2.0
        * transmittance_with_faces
        / ((1.0 - f) ** 2 + np.sqrt((1.0 - f) ** 4 + 4.0 * (f * transmittance_with_faces) ** 2))
    )
    return -np.log(within("transmittance inside the film", inside, 0.0, 1.0)) / thickness_mm


def transmittance(
    depth_mm: ArrayLike, cos_in_air: ArrayLike, absorption_per_mm: Array, index: float = indices.URUSHI
) -> Array:
    """Return the share [..., bands] of light from air, at an angle [...], that reaches a depth."""
    cosine = fresnel.cos_inside(cos_in_air, 1.0, index).real
    path_mm = within("depth", depth_mm, 0.0, np.inf) / cosine
    return np.exp(-path_mm[..., None] * absorption_per_mm)

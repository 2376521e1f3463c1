"""Reflectance of a paint as an instrument measures it, and reflectance inside the binder: two types, and
Saunderson's conversion between them.

A binder's glossy face reflects part of the light before it enters, and most of the diffuse light that would leave.
If a paint reflects 0.50 in air, gloss excluded, the layer inside reflects 0.74 under an index of 1.5. The two
reflectances must not be mixed, so the types have no arithmetic, and only `Face` converts one to the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.optics import fresnel
from coupole.appearance.spectra.grid import Array, within
from coupole.errors import InputError

Geometry = Literal["gloss excluded", "gloss included", "45:0"]
"""Geometry of an instrument. Gloss excluded: diffuse light measured along the normal, or the reverse, with a gloss
trap (d:8, SCE). Gloss included: without the trap (d:8, SCI). 45:0: light at 45 degrees measured along the
normal."""
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class MeasuredReflectance:
    """Reflectance in air, as an instrument measures it: fractions [..., bands]. Noise may lower them below 0, and
    gloss may raise them above 1."""

    values: Array


@dataclass(frozen=True, eq=False)
class InternalReflectance:
    """Reflectance of a layer inside its binder, for diffuse light: 0 to 1, [..., bands]. Raises InputError for
    values outside this range."""

    values: Array

    def __post_init__(self) -> None:
        within("R inside the binder", self.values, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Face:
    """A binder's face against air, for one geometry of measurement; numbers or [bands].

    Saunderson, J. Opt. Soc. Am. 32, 727 (1942): seen = passing R/(1 - inner R) + gloss.
    """

    passing: Array
    """Share of the incident light that enters, times the share of the emerging light that is measured."""
    inner: Array
    """Reflectance for diffuse light from within (k2)."""
    gloss: Array
    """Light that the face itself reflects to the instrument."""

    def reflectance_in_air(self, internal: InternalReflectance) -> MeasuredReflectance:
        """Return the reflectance in air of a layer under this face."""
        r = internal.values
        return MeasuredReflectance(np.asarray(self.passing * r / (1.0 - self.inner * r) + self.gloss))

    def inside(self, measured_reflectance: MeasuredReflectance) -> InternalReflectance:
        """Return the reflectance of the layer under this face. Raises InputError if no layer can have the measured
        reflectance.
        """
        r = np.asarray(measured_reflectance.values, dtype=float) - self.gloss
        internal = np.asarray(r / (self.passing + self.inner * r))
        internal = np.where((internal > 1.0) & (internal < 1.0 + _ROUNDING), 1.0, internal)
        wrong = ~((internal >= 0.0) & (internal <= 1.0))
        if wrong.any():
            low, high = (np.broadcast_to(v, internal.shape)[wrong][0] for v in (self.gloss, self.brightest))
            raise InputError(
                f"seen through this face, a paint has a reflectance of {low:.3g} to {high:.3g}; found "
                f"{np.asarray(measured_reflectance.values)[wrong][0]:.3g}, which would be below 0 or above 1 "
                f"inside the binder: check whether gloss is included, and whether the sample has a glossy face"
            )
        return InternalReflectance(internal)

    @property
    def brightest(self) -> Array:
        """Reflectance in air of a layer that reflects everything."""
        return np.asarray(self.passing / (1.0 - self.inner) + self.gloss)


def face(index: ArrayLike, geometry: Geometry = "gloss excluded") -> Face:
    """Return the face of a transparent binder of real index n >= 1, a number or [bands], for a geometry of
    measurement.

    With diffuse light and measurement along the normal, the share 1 - F(0) passes inwards and 1 - k2 outwards, or
    the reverse; the product is the same. At 45:0 the emerging radiance is measured along the normal: (1 - F(45))
    (1 - F(0))/n^2.
    """
    if geometry not in get_args(Geometry):
        raise InputError(f"geometry: expected one of {', '.join(get_args(Geometry))}; found {geometry!r}")
    n = within("index of the binder", index, 1.0, 10.0)
    inner, along = fresnel.diffuse_internal(n), fresnel.reflectance(1.0, n)
    if geometry == "45:0":
        passing = (1.0 - fresnel.reflectance(np.sqrt(0.5), n)) * (1.0 - along) / n**2
    else:
        passing = (1.0 - along) * (1.0 - inner)
    gloss = along if geometry == "gloss included" else np.zeros_like(along)
    return Face(np.asarray(passing), np.asarray(inner), np.asarray(gloss))


BARE = Face(np.ones(()), np.zeros(()), np.zeros(()))
"""No face, as for dry powder or matt distemper. The measured reflectance and the internal reflectance are the
same."""

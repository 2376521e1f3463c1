"""Mixtures of pigments: coefficients add by concentration (Duncan, J. Oil Colour Chem. Assoc. 32, 296, 1949).

A pigment has absorption K and scattering S [81] per mm at full concentration in its binder. Where only opaque
samples were measured, K and S are relative to the scattering of a white: enough for opaque mixtures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.spectra.grid import Array, within
from coupole.errors import InputError

_ENOUGH = 1e-10


@dataclass(frozen=True)
class Pigment:
    """Coefficients [bands] per mm, or relative to a white's scattering."""

    name: str
    absorption: Array
    scattering: Array


@dataclass(frozen=True)
class Recipe:
    """What `fit` found."""

    concentrations: dict[str, float]
    """They sum to 1; an unused pigment has 0."""
    reflectance: InternalReflectance
    """[bands] of the mixture."""
    rms: float
    """Root mean square residual of the mixture, in reflectance."""


def mixture(pigments: Sequence[Pigment], concentrations: ArrayLike) -> Pigment:
    """The mixture as a pigment; concentrations are normalised to sum 1."""
    shares = within("concentration", concentrations, 0.0, 1e12)
    if shares.shape != (len(pigments),) or shares.sum() == 0.0:
        raise InputError(
            f"mixture: expected {len(pigments)} concentrations, not all zero; found {shares.tolist()}; "
            "give one for each pigment"
        )
    shares = shares / shares.sum()
    return Pigment(
        " + ".join(f"{100 * share:.0f} % {p.name}" for share, p in zip(shares, pigments, strict=True) if share),
        np.tensordot(shares, [p.absorption for p in pigments], 1),
        np.tensordot(shares, [p.scattering for p in pigments], 1),
    )


def from_opaque(name: str, reflectance: InternalReflectance, scattering: ArrayLike = 1.0) -> Pigment:
    """A pigment of known relative scattering, from an opaque sample's reflectance [bands]."""
    s = np.broadcast_to(np.asarray(scattering, dtype=float), reflectance.values.shape)
    return Pigment(name, kubelka_munk.k_over_s(reflectance.values) * s, s)


def from_tint(
    name: str,
    masstone: InternalReflectance,
    tint: InternalReflectance,
    white: InternalReflectance,
    concentration: float,
) -> Pigment:
    """A pigment relative to a white of scattering 1, from opaque samples: pure, tinted with the white, white
    alone.

    `concentration` is the pigment's in the tint. Duncan's two equations: K = (K/S of the masstone) S, and
    c K + (1 - c) K_w = (K/S of the tint) (c S + 1 - c).
    """
    c = float(within("concentration of the tint", concentration, 1e-6, 1.0 - 1e-6))
    pure, mixed, base = (kubelka_munk.k_over_s(r.values) for r in (masstone, tint, white))
    scattering = (1.0 - c) / c * (mixed - base) / np.where(pure == mixed, np.nan, pure - mixed)
    if not np.all(scattering > 0.0):
        raise InputError(
            f"pigment {name}: expected a tint between its masstone and the white at every wavelength; "
            f"it is not in {np.count_nonzero(~(scattering > 0.0))} bands; measure the three samples again"
        )
    return Pigment(name, pure * scattering, scattering)


def opaque_reflectance(pigment: Pigment) -> InternalReflectance:
    """R_inf [bands]."""
    return InternalReflectance(kubelka_munk.opaque(pigment.absorption / pigment.scattering))


def fit(target: InternalReflectance, pigments: Sequence[Pigment]) -> Recipe:
    """The mixture whose opaque reflectance is nearest to `target` [bands], by least squares.

    First the linear problem sum c_i (K_i - Q S_i) = 0 with Q the target's K/S, with bands weighted to give
    residuals in reflectance; then Gauss-Newton on reflectance itself, with concentrations not negative.
    """
    from scipy.optimize import least_squares, nnls

    k = np.stack([p.absorption for p in pigments], axis=1)
    s = np.stack([p.scattering for p in pigments], axis=1)
    wanted = target.values
    q = kubelka_munk.k_over_s(wanted)
    # dR/dQ of R = 1/(1 + Q + sqrt(Q^2 + 2Q)) is -R/sqrt(Q^2 + 2Q); the slope of a pure white is infinite.
    weight = wanted / np.sqrt(np.maximum(q * (q + 2.0), 1e-12)) / s.mean()
    system = weight[:, None] * (k - q[:, None] * s)
    emphasis = 10.0 * np.abs(system).max() + 1.0
    start, _ = nnls(np.vstack([system, np.full(len(pigments), emphasis)]), np.append(np.zeros(len(q)), emphasis))

    def missing(shares: Array) -> Array:
        return kubelka_munk.opaque((k @ shares) / (s @ shares)) - wanted

    if len(pigments) == 1:
        shares = np.ones(1)
    else:
        # R does not depend on the sum of concentrations; an additional residual fixes it at 1.
        found = least_squares(
            lambda c: np.append(missing(c), c.sum() - 1.0),
            np.maximum(start / start.sum(), 1e-6),
            bounds=(0.0, 2.0),
            xtol=_ENOUGH,
            ftol=_ENOUGH,
            gtol=_ENOUGH,
        )
        shares = found.x / found.x.sum()
    missed = missing(shares)
    return Recipe(
        {p.name: float(c) for p, c in zip(pigments, shares, strict=True)},
        InternalReflectance(wanted + missed),
        float(np.sqrt(np.mean(missed**2))),
    )

"""Makie: decomposition of a photograph of metal powder on lacquer (Durikovic et al. 2002, section 4).

A pixel of the picture is T = p m + sum of q_l c_l: m is the colour of the metallic finish alone, and c_l are the
colours of up to three lacquers. All are photographed under the same light, linear and not negative. p becomes the
alpha channel: the weight of the metallic BRDF. The residual T - p m becomes the colour channels: the lacquers'
diffuse light.

With three lacquers there are four unknowns and three channels. Eq. 4 takes the largest p that leaves no lacquer
negative. This is exact where at least one lacquer with positive m' is absent, and too large elsewhere. Where the
weights are known to sum to 1 (inside the drawing), p is found without this assumption. With one or two lacquers
the system is determined, and is solved by least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_SINGULAR = 1e-9
_SUM_IS_ONE = 1e-3
"""Largest deviation of a sum from 1. If the metal's weights m' sum to 1 within this, the sum does not determine
p."""


@dataclass(frozen=True)
class Makie:
    """RGBA of a makie drawing."""

    alpha: Array
    """[...], p: the share of metal."""
    residual: Array
    """[..., 3], the lacquers' part of the picture, in its unit."""
    clamped_share: float
    """Share of the pixels with p outside 0 to 1 by more than rounding, because of noise, shadow or a wrong sample
    colour."""


def decompose(
    picture: Array,
    metal: ArrayLike,
    lacquers: ArrayLike,
    *,
    region: Literal["anywhere", "inside"] = "anywhere",
) -> Makie:
    """Decompose `picture` [..., 3] (linear) into `metal` [3] and `lacquers` [1 to 3, 3].

    `region` says whether all pixels lie inside the drawing, where the weights sum to 1; with three lacquers p is
    then (1 - sum T')/(1 - sum m') instead of Eq. 4.
    """
    m = np.asarray(metal, dtype=float)
    c = np.atleast_2d(np.asarray(lacquers, dtype=float))
    t = np.asarray(picture, dtype=float)
    if t.shape[-1] != 3 or m.shape != (3,) or c.shape[1] != 3 or not 1 <= len(c) <= 3:
        raise InputError(
            f"makie: expected a picture [..., 3], a metal [3] and one to three lacquers [n, 3]; found {t.shape}, "
            f"{m.shape} and {c.shape}; give linear colours of three channels"
        )
    p = _three_lacquers(t, m, c, region) if len(c) == 3 else _few_lacquers(t, m, c)
    alpha = np.clip(p, 0.0, 1.0)
    return Makie(alpha, t - alpha[..., None] * m, float(np.mean(np.abs(p - alpha) > 1e-9)))


def makie_brdf(wi: Array, wo: Array, *, alpha: float, residual: ArrayLike, metallic: Brdf) -> Array:
    """BRDF of one pixel: `metallic` by its alpha, the residual as a Lambertian reflectance [bands]."""
    above = ((wi[..., 2] > 0.0) & (wo[..., 2] > 0.0))[..., None]
    return np.asarray(alpha * metallic(wi, wo) + above * np.asarray(residual, dtype=float) / np.pi)


def _three_lacquers(t: Array, m: Array, c: Array, region: str) -> Array:
    """Decompose by Eqs 2 to 4."""
    if abs(np.linalg.det(c)) < _SINGULAR * np.prod(np.linalg.norm(c, axis=1)):
        raise InputError(
            "makie: expected three lacquers of independent colours; these lie in one plane; give two of them"
        )
    t_in, m_in = np.linalg.solve(c.T, t.reshape(-1, 3).T).T.reshape(t.shape), np.linalg.solve(c.T, m)
    if region == "inside":
        if abs(1.0 - m_in.sum()) < _SUM_IS_ONE:
            raise InputError(
                "makie: expected a metal that is not an average of the lacquers; its weights sum to 1, so that "
                "the sum rule has no effect; decompose with region 'anywhere'"
            )
        return np.asarray((1.0 - t_in.sum(axis=-1)) / (1.0 - m_in.sum()))
    positive = m_in > _SINGULAR
    if not positive.any():
        raise InputError(
            "makie: expected a metal that contains some of a lacquer's colour, found weights "
            f"{m_in.round(3).tolist()}; check the sample colours"
        )
    return np.asarray((t_in[..., positive] / m_in[positive]).min(axis=-1))


def _few_lacquers(t: Array, m: Array, c: Array) -> Array:
    basis = np.vstack([m, c])
    if np.linalg.matrix_rank(basis, tol=1e-6 * np.abs(basis).max()) < len(basis):
        raise InputError("makie: expected a metal of another colour than the lacquers; check the sample colours")
    return np.asarray(t @ np.linalg.pinv(basis)[:, 0])

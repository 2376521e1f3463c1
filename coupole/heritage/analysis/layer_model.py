"""Choice of the model that a paint layer needs, and the size of its grains (Dumazet et al. 2008, sections 3.4 and
3.5).

Two fluxes are valid for light that is diffuse inside the layer: under diffuse illumination, or where the layer
scatters so much that nothing reaches its ground unscattered. A thin or clear layer under directional light (a
dome's LEDs, 45:0) needs four fluxes. A layer that hides its ground needs K/S only, from R_inf. If spectra under
directional light were measured, they decide which model is needed. Otherwise the film is computed with four
fluxes for grains that scatter equally to all sides, for which K = 2 k and S = 3 s/4 (Mudgett and Richards, Appl.
Opt. 10, 1485, 1971). Two fluxes are enough if the light that reaches the ground unscattered changes the
reflectance by at most twice the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from coupole.appearance.matter import four_flux, kubelka_munk
from coupole.appearance.matter.glossy_face import Face
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError
from coupole.heritage.analysis.layer_fit import Coefficients, Film

Model = Literal["two fluxes", "four fluxes", "K/S only"]


@dataclass(frozen=True)
class Deserved:
    """The verdict and its reasons."""

    model: Model
    because: str
    difference: float
    """Largest difference between the two models under directional light, among all bands and grounds."""
    unscattered_share: float
    """Largest share of directional light that reaches the ground unscattered, among all bands."""


@dataclass(frozen=True)
class GrainRatio:
    """Mean grain size of one grinding, relative to the mean grain size of another."""

    ratio: float
    u_ratio: float
    bands: int


def deserved_model(coefficients: Coefficients, films: list[Film], face: Face, noise: float) -> Deserved:
    """Choose the model from K and S alone."""
    sure = coefficients.determined_bands
    if not sure.any():
        return Deserved(
            "K/S only", "the films hide their grounds in every band: this gives K/S, but not K and S", 0.0, 0.0
        )
    k, s = np.maximum(coefficients.absorption, 0.0), coefficients.scattering
    total = 4.0 / 3.0 * s
    difference, direct_share, through = 0.0, 0.0, 0.0
    for film in films:
        if film.ground is None:
            continue
        h, ground = film.thickness_mm, film.ground
        layer = four_flux.Layer(k, s, 0.5 * k, 0.5 * total, 0.5 * total, h)
        rho, tau, _, _, direct = four_flux.response(layer)
        directional, _ = four_flux.reflectances(layer, four_flux.Background(ground, ground))
        diffuse = kubelka_munk.over(rho, tau, ground)
        leaving = face.passing / (1.0 - face.inner * diffuse)
        difference = max(difference, float((leaving * np.abs(directional - diffuse))[sure].max()))
        direct_share = max(direct_share, float(direct[sure].max()))
        through = max(through, float((leaving * direct * ground * tau / (1.0 - rho * ground))[sure].max()))
    because = (
        f"{100.0 * direct_share:.2g} % of directional light reaches the ground unscattered, and adds up to "
        f"{through:.3f} to the reflectance that is seen; twice the noise is {2.0 * noise:.3f}"
    )
    model: Model = "two fluxes" if through <= 2.0 * noise else "four fluxes"
    return Deserved(model, because, difference, direct_share)


def deserved_by_measurement(
    diffuse: tuple[Array, Array], directional: tuple[Array, Array], transmittance: Array, noise: float
) -> Deserved:
    """Choose the model from spectra of one film under both kinds of light, over black and over white [n]."""
    differences = np.stack([b - a for a, b in zip(diffuse, directional, strict=True)])
    chi2, count = float(np.sum(differences**2) / (2.0 * noise**2)), differences.size
    largest, direct_share = float(np.abs(differences).max()), float(transmittance.max())
    if chi2 <= count + 3.0 * np.sqrt(2.0 * count):
        because = (
            f"spectra under directional light agree with the spectra under diffuse light "
            f"within the noise of {noise:g}"
        )
        return Deserved("two fluxes", because, largest, direct_share)
    because = (
        f"spectra under directional light differ by up to {largest:.3f} from those under diffuse light, "
        f"{np.sqrt(chi2 / count):.1f} times the noise of their difference"
    )
    return Deserved("four fluxes", because, largest, direct_share)


def grain_ratio(first: tuple[Array, Array], second: tuple[Array, Array]) -> GrainRatio:
    """Return d1/d2 of two grindings of one pigment at the same concentration, from S and its uncertainty [n] for
    each.

    Grains larger than the wavelength scatter by their cross-sections, so S per volume of pigment is proportional
    to 1/d. The papers say that K and S depend on the grains, and give no formula. The formula here is valid for
    grains above about 2 um. Raises InputError if no band is known well for both grindings.
    """
    (s1, u1), (s2, u2) = first, second
    relative = np.hypot(u1 / s1, u2 / s2)
    is_known = np.isfinite(relative) & (relative < 0.25) & (relative > 0.0)
    if not is_known.any():
        raise InputError(
            "grain size: expected bands in which S of both grindings is known within 25 %; found none"
        )
    ratios, weights = (s2 / s1)[is_known], relative[is_known] ** -2.0
    ratio = float(np.exp(np.sum(weights * np.log(ratios)) / weights.sum()))
    # Bands differ by more than noise where the law does not hold: their spread counts, not that over its root.
    scatter = float(np.sqrt(np.sum(weights * np.log(ratios / ratio) ** 2) / weights.sum()))
    return GrainRatio(ratio, ratio * max(scatter, float(relative[is_known].min())), int(is_known.sum()))

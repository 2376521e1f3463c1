"""A film's spectrum at a thickness other than the measured one, with the error of the two-flux model.

Over another ground the two fluxes are exact: they define a film's reflectance and transmittance for diffuse light,
and a diffusing ground makes all light diffuse. At another thickness they are only a model, because light inside a
layer is not diffuse near its faces. Radiative transfer gives the possible error. Two other layers are computed:
one has grains that scatter evenly to all sides, the other has grains that scatter forward. Both get the
reflectance and the transmittance of the measured film, and then the requested thickness. The largest difference of
these layers from the two fluxes is the half width of a rectangular distribution around the two fluxes (JCGM 100,
4.3.7).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.matter.glossy_face import Face
from coupole.appearance.matter.scattering_layer import diffuse_response
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError
from coupole.heritage.analysis import layer_fit
from coupole.heritage.analysis.layer_fit import Coefficients, Film

MEAN_COSINES = (0.0, 0.8)
"""Mean cosines of grains that scatter evenly, and of grains larger than the wavelength in a binder; these have 0.7
to 0.9 by Mie's theory."""
_ROUNDS, _STEP = 12, 1e-4
_THINNEST, _THICKEST = -14.0, 7.0
"""Bounds of the logarithms of optical depths in which a layer is searched."""
_LEAST_TRANSMITTANCE = 1e-9
"""Least transmittance; smaller values are rounding errors."""


@dataclass(frozen=True, eq=False)
class FilmAtThickness:
    """Predicted spectrum of a film; NaN in bands in which the measured films do not determine S."""

    thickness_mm: float
    ground_name: str
    reflectance: Array
    """[n] reflectance as the instrument would measure it."""
    u_measured: Array
    """[n], standard uncertainty from noise, grounds and thicknesses of the measured films."""
    u_model: Array
    """[n], standard uncertainty from the two-flux model."""

    @property
    def u_reflectance(self) -> Array:
        """[n], standard uncertainty from both parts."""
        return np.hypot(self.u_measured, self.u_model)


def films_at(
    coefficients: Coefficients, films: Sequence[Film], face: Face, thicknesses_mm: Sequence[float]
) -> list[FilmAtThickness]:
    """Predict the film at each thickness over each measured ground. Raises InputError if no film over a ground was
    measured."""
    grounds = {film.ground_name: film for film in films if film.ground is not None}
    if thicknesses_mm and not grounds:
        raise InputError("expected a film of known thickness over a ground; found opaque films only")
    return [
        film_at(coefficients, films, face, thickness_mm, ground)
        for thickness_mm in thicknesses_mm
        for ground in grounds.values()
    ]


def film_at(
    coefficients: Coefficients, films: Sequence[Film], face: Face, thickness_mm: float, over: Film
) -> FilmAtThickness:
    """Predict the film with a thickness over the ground of one of the measured films."""
    background = np.asarray(over.ground, float)
    reference_mm = _nearest_mm(films, thickness_mm)
    prediction = layer_fit.predict(coefficients, face, thickness_mm, background)
    two_fluxes = np.maximum(coefficients.absorption, 0.0), coefficients.scattering
    by_two_fluxes = _film_reflectance(*kubelka_munk.layer(*two_fluxes, thickness_mm), background, face)
    rho, tau = kubelka_munk.layer(*two_fluxes, reference_mm)
    off = np.zeros_like(rho)
    for mean_cosine in MEAN_COSINES:
        depths = _matching_depths(rho, tau, two_fluxes, reference_mm, mean_cosine)
        depths_here = [depth * thickness_mm / reference_mm for depth in depths]
        by_transfer = _film_reflectance(
            *diffuse_response(depths_here[0], depths_here[1], mean_cosine), background, face
        )
        off = np.maximum(off, np.abs(by_transfer - by_two_fluxes))
    determined = np.where(coefficients.determined_bands, 1.0, np.nan)
    return FilmAtThickness(
        thickness_mm,
        over.ground_name,
        prediction.seen * determined,
        prediction.u_seen * determined,
        off / np.sqrt(3.0) * determined,
    )


def _nearest_mm(films: Sequence[Film], thickness_mm: float) -> float:
    """Return the thickness, nearest by ratio, of a film over a ground."""
    measured_mm = [film.thickness_mm for film in films if film.ground is not None]
    return min(measured_mm, key=lambda thickness: abs(np.log(thickness / thickness_mm)))


def _film_reflectance(rho: Array, tau: Array, ground: Array, face: Face) -> Array:
    inside = kubelka_munk.over(rho, tau, ground)
    return np.asarray(face.passing * inside / (1.0 - face.inner * inside) + face.gloss)


def _matching_depths(
    rho: Array, tau: Array, two_fluxes: tuple[Array, Array], thickness_mm: float, mean_cosine: float
) -> tuple[Array, Array]:
    """Return the optical depths [n] of absorption and of scattering of the layer that reflects rho and transmits
    tau.

    Newton's steps begin at K = 2 k and S = 3/4 s (1 - mean cosine). These values are right for thick layers.
    """
    k, s = two_fluxes
    start = np.stack([0.5 * k * thickness_mm, 4.0 / 3.0 * s * thickness_mm / (1.0 - mean_cosine)])
    logs = np.log(np.maximum(start, np.exp(_THINNEST)))
    target = np.stack([rho, np.log(np.maximum(tau, _LEAST_TRANSMITTANCE))])

    def off(logs: Array) -> Array:
        absorption, scattering = np.exp(logs)
        rho_here, tau_here = diffuse_response(absorption, scattering, mean_cosine)
        log_tau = np.log(np.maximum(tau_here, _LEAST_TRANSMITTANCE))
        return np.asarray(np.stack([rho_here, log_tau]) - target)

    for _ in range(_ROUNDS):
        logs = np.clip(logs - _newton_step(off, logs), _THINNEST, _THICKEST)
    depths = np.exp(logs)
    return depths[0], depths[1]


def _newton_step(off: Callable[[Array], Array], logs: Array) -> Array:
    """[2, n] Newton's step, which changes each unknown by at most a factor of e."""
    here = off(logs)
    slopes = np.stack([(off(logs + _STEP * unit) - here) / _STEP for unit in np.eye(2)[:, :, None]], axis=1)
    matrices = np.moveaxis(slopes, -1, 0)
    floor = 1e-12 * np.eye(2)
    normal = np.einsum("nij,nik->njk", matrices, matrices) + floor
    step = np.linalg.solve(normal, np.einsum("nij,in->nj", matrices, here)[..., None])[..., 0]
    return np.asarray(np.clip(step.T, -1.0, 1.0))

"""K and S of a paint from its films over grounds, with uncertainties (Kubelka and Munk 1931; Dumazet et al. 2008,
Eqs 5-7).

Each spectrum of a film is one equation for each band, in the measured reflectance. Two grounds, an opaque and a
thin sample, or a series of thicknesses are the same problem, solved by weighted least squares. With alpha = (K+S)
h, sigma = S h, x^2 = alpha^2 - sigma^2 and beta = x coth x, a film over a ground g reflects

    R = (sigma - g (alpha - beta))/(alpha + beta - g sigma)

inside the binder, and (sigma)/(alpha + x) if it is opaque. The formula is also valid for K a little below 0, which
noise can give for a white paint. Such estimates are not clipped, so that intervals contain the truth as often as
stated.

Uncertainties are propagated linearly (JCGM 100): noise of each spectrum, of each ground, and the thicknesses,
which are common to all bands and to all films of the same thickness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.glossy_face import Face
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

COVERAGE_FACTOR = 1.96
"""Coverage factor of 95 %."""
LEAST_DETERMINED = 0.2
"""Relative standard uncertainty of S above which a band's S counts as undetermined, because the film hides its
ground."""
_LEAST_UNLIKE = 40.0
"""Least difference of films that is more than noise, in squared standard uncertainties."""
_STEPS = 60
_LEAST_S = 1e-6


@dataclass(frozen=True, eq=False)
class Film:
    """One spectrum of a film."""

    reflectance: Array
    """[n] reflectance in air."""
    ground: Array | None
    """[n] reflectance of the ground inside the binder; None for an opaque film."""
    ground_name: str = ""
    """Name of the ground; films over the same ground share its error."""
    u_ground: Array | float = 0.0
    """[n] standard uncertainty of the ground's reflectance inside the binder."""
    thickness_mm: float = 1.0
    """Thickness; 1 if it is not known, and K and S are then for the whole layer."""
    u_thickness_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class Coefficients:
    """K and S for each band."""

    absorption: Array
    """[n] per mm, or for the layer."""
    scattering: Array
    covariance: Array
    """[n, 2, 2] covariance of K and S."""
    chi2: Array
    """[n], squared residuals divided by their variances. The expected value is the number of spectra minus 2."""
    unlike: Array
    """[n] squared differences, divided by the noise's variance: of the spectra from their mean, or from their
    grounds if these differences are smaller. The values are near 0 for films that hide their ground, and for
    nearly invisible films.
    """
    spectra: int

    @property
    def u_absorption(self) -> Array:
        """[n], standard uncertainty."""
        return np.sqrt(self.covariance[:, 0, 0])

    @property
    def u_scattering(self) -> Array:
        """[n], standard uncertainty."""
        return np.sqrt(self.covariance[:, 1, 1])

    @property
    def determined_bands(self) -> NDArray[np.bool_]:
        """[n] True for bands in which the films show their grounds enough to determine S."""
        is_determined = self.u_scattering < LEAST_DETERMINED * self.scattering
        return np.asarray(is_determined & (self.unlike > _LEAST_UNLIKE))


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predicted spectrum of a film, with its standard uncertainty."""

    seen: Array
    u_seen: Array


def reflectance_inside(
    absorption: Array, scattering: Array, thickness_mm: float, ground: Array | float | None
) -> Array:
    """Return the reflectance of a film over a ground, or of an opaque film (ground None), by the module's formula.
    K may be slightly negative."""
    h = 1.0 if ground is None else thickness_mm
    alpha, sigma = (absorption + scattering) * h, scattering * h
    square = alpha**2 - sigma**2
    x = np.sqrt(np.abs(square))
    if ground is None:
        return np.asarray(sigma / (alpha + np.where(square > 0.0, x, 0.0)))
    small = x < 1e-4
    safe = np.where(small, 1.0, x)
    # Below 0 the hyperbolic cotangent is a cotangent, whose first pole is far beyond what noise does.
    beta = np.where(square >= 0.0, safe / np.tanh(safe), safe / np.tan(np.minimum(safe, 1.5)))
    beta = np.where(small, 1.0 + square / 3.0, beta)
    return np.asarray((sigma - ground * (alpha - beta)) / (alpha + beta - ground * sigma))


def fit(films: Sequence[Film], face: Face, noise: float) -> Coefficients:
    """Fit K and S of every band to two or more films; `noise` is the standard uncertainty of a spectrum's value.

    Raises InputError for films that do not distinguish K from S: fewer than two films, or films with the same
    ground and thickness.
    """
    _check(films)
    k, s = _start(films, face)
    y = np.stack([film.reflectance for film in films], axis=1)
    damping = np.full(len(k), 1e-3)
    weight = 1.0 / _variances(k, s, films, face, noise)
    cost = np.sum(weight * (y - _film_reflectances(k, s, films, face)) ** 2, axis=1)
    for step in range(_STEPS):
        if step % 10 == 5:  # grounds and thicknesses count as much as K and S let them
            weight = 1.0 / _variances(k, s, films, face, noise)
            cost = np.sum(weight * (y - _film_reflectances(k, s, films, face)) ** 2, axis=1)
        jacobian = _jacobian(k, s, films, face)
        residuals = y - _film_reflectances(k, s, films, face)
        normal = np.einsum("nfi,nf,nfj->nij", jacobian, weight, jacobian)
        slope = np.einsum("nfi,nf,nf->ni", jacobian, weight, residuals)
        scale = np.einsum("nii->ni", normal) + 1e-6 * np.einsum("nii->n", normal)[:, None] + 1e-12
        inverse_normal = _inverse(normal + np.eye(2) * (damping[:, None] * scale)[:, None, :])
        step_k, step_s = np.einsum("nij,nj->in", inverse_normal, slope)
        new_k, new_s = k + step_k, np.maximum(s + step_s, _LEAST_S)
        new_k = np.maximum(new_k, -0.3 * new_s)
        trial = np.sum(weight * (y - _film_reflectances(new_k, new_s, films, face)) ** 2, axis=1)
        better = trial <= cost
        k, s = np.where(better, new_k, k), np.where(better, new_s, s)
        cost = np.where(better, trial, cost)
        damping = np.where(better, damping * 0.2, np.minimum(damping * 5.0, 1e8))
    return _with_uncertainty(k, s, y, films, face, noise)


def predict(
    coefficients: Coefficients, face: Face, thickness_mm: float, ground: Array | float | None
) -> Predicted:
    """Predict the spectrum of a film with a thickness over a ground (inside the binder, known exactly)."""
    k, s = coefficients.absorption, coefficients.scattering
    films = [Film(k, None if ground is None else np.broadcast_to(ground, k.shape), thickness_mm=thickness_mm)]
    slope = _jacobian(k, s, films, face)[:, 0]
    return Predicted(
        _film_reflectances(k, s, films, face)[:, 0],
        np.sqrt(np.einsum("ni,nij,nj->n", slope, coefficients.covariance, slope)),
    )


def _check(films: Sequence[Film]) -> None:
    if len(films) < 2:
        raise InputError(
            f"expected two or more spectra of films, found {len(films)}: one spectrum cannot separate K from S"
        )
    kinds = {(film.ground_name, film.ground is None, film.thickness_mm) for film in films}
    if len(kinds) < 2:
        raise InputError(
            "expected films over two grounds, of two thicknesses, or an opaque film; found films that are "
            "alike, which cannot separate K from S"
        )


def _start(films: Sequence[Film], face: Face) -> tuple[Array, Array]:
    """Return the best point of a grid over K/S and S, which is near enough to the minimum for the following
    steps."""
    thickest = max((film.thickness_mm for film in films if film.ground is not None), default=1.0)
    y = np.stack([film.reflectance for film in films], axis=1)
    best = np.full(len(y), np.inf)
    k, s = np.zeros(len(y)), np.ones(len(y))
    for sigma in np.geomspace(0.02, 20.0, 13):
        for ratio in np.geomspace(1e-3, 30.0, 13):
            here = np.full(len(y), sigma / thickest)
            cost = np.sum((y - _film_reflectances(ratio * here, here, films, face)) ** 2, axis=1)
            nearer = cost < best
            best = np.where(nearer, cost, best)
            k, s = np.where(nearer, ratio * here, k), np.where(nearer, here, s)
    return k, s


def _film_reflectances(k: Array, s: Array, films: Sequence[Film], face: Face) -> Array:
    """[n, films] reflectances as instruments measure them."""
    return np.stack([_one_seen(k, s, film, face, film.thickness_mm, film.ground) for film in films], axis=1)


def _one_seen(k: Array, s: Array, film: Film, face: Face, h: float, ground: Array | None) -> Array:
    r = reflectance_inside(k, s, h, ground)
    return np.asarray(face.passing * r / (1.0 - face.inner * r) + face.gloss)


def _jacobian(k: Array, s: Array, films: Sequence[Film], face: Face) -> Array:
    """[n, films, 2] derivatives with respect to K and S."""
    step = 1e-5 * (np.abs(k) + s)
    return np.stack(
        [
            (_film_reflectances(k + step, s, films, face) - _film_reflectances(k - step, s, films, face))
            / (2.0 * step)[:, None],
            (_film_reflectances(k, s + step, films, face) - _film_reflectances(k, s - step, films, face))
            / (2.0 * step)[:, None],
        ],
        axis=2,
    )


def _effects(k: Array, s: Array, films: Sequence[Film], face: Face) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the changes of each film [n, films] from one standard uncertainty of each ground, and of each
    thickness."""
    grounds: dict[str, Array] = {}
    thicknesses: dict[str, Array] = {}
    for number, film in enumerate(films):
        if film.ground is None:
            continue
        at = (k, s, film, face)
        by_ground = _one_seen(*at, film.thickness_mm, film.ground + 1e-5)
        by_ground = (by_ground - _one_seen(*at, film.thickness_mm, film.ground - 1e-5)) / 2e-5
        of_ground = grounds.setdefault(film.ground_name, np.zeros((len(k), len(films))))
        of_ground[:, number] = by_ground * film.u_ground
        step = 1e-5 * film.thickness_mm
        by_h = _one_seen(*at, film.thickness_mm + step, film.ground)
        by_h = (by_h - _one_seen(*at, film.thickness_mm - step, film.ground)) / (2.0 * step)
        coat = f"{film.thickness_mm:.9g}"
        of_coat = thicknesses.setdefault(coat, np.zeros((len(k), len(films))))
        of_coat[:, number] = by_h * film.u_thickness_mm
    return grounds, thicknesses


def _variances(k: Array, s: Array, films: Sequence[Film], face: Face, noise: float) -> Array:
    grounds, thicknesses = _effects(k, s, films, face)
    return np.asarray(noise**2 + sum(effect**2 for effect in (*grounds.values(), *thicknesses.values())) + 1e-14)


def _unlike(y: Array, films: Sequence[Film], face: Face) -> Array:
    variation = np.sum((y - y.mean(axis=1)[:, None]) ** 2, axis=1)
    change = np.zeros(len(y))
    for film in films:
        if film.ground is not None:
            bare = face.passing * film.ground / (1.0 - face.inner * film.ground) + face.gloss
            change += 0.5 * (film.reflectance - bare) ** 2
    return np.asarray(np.minimum(variation, change))


def _inverse(matrices: Array) -> Array:
    """Return the inverses of symmetric matrices [n, 2, 2]; zeros for a matrix that has none."""
    a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    determinant = a * d - b * b
    usable = determinant > 1e-300
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-b, a], axis=1)], axis=1)
    return np.asarray(
        np.where(usable[:, None, None], adjugate, 0.0) / np.where(usable, determinant, 1.0)[:, None, None]
    )


def _with_uncertainty(
    k: Array, s: Array, y: Array, films: Sequence[Film], face: Face, noise: float
) -> Coefficients:
    jacobian, weight = _jacobian(k, s, films, face), 1.0 / _variances(k, s, films, face, noise)
    normal = np.einsum("nfi,nf,nfj->nij", jacobian, weight, jacobian)
    floor = 1e-10 * np.einsum("nii->n", normal)[:, None, None] * np.eye(2)
    gain = np.einsum("nij,nfj,nf->nif", _inverse(normal + floor), jacobian, weight)
    grounds, thicknesses = _effects(k, s, films, face)
    covariance = noise**2 * np.einsum("nif,njf->nij", gain, gain)
    for effect in (*grounds.values(), *thicknesses.values()):
        shift = np.einsum("nif,nf->ni", gain, effect)
        covariance += shift[:, :, None] * shift[:, None, :]
    residuals = y - _film_reflectances(k, s, films, face)
    return Coefficients(
        k,
        s,
        covariance,
        np.sum(weight * residuals**2, axis=1),
        _unlike(y, films, face) / noise**2,
        len(films),
    )

"""The BRDF of a finish from linear photographs of a coated sphere (Durikovic et al. 2002, section 3.1).

Each pixel of the sphere has a different normal. So one photograph under one distant light has thousands of samples
of an isotropic BRDF, and several lights cover it. Two lobes of facets are fitted first (`finish_lobes`), then a
table of the residual's logarithm (`half_angle_table`). This residual is nearly constant, so smoothness between
photographs does not flatten a peak. The mean over a pixel lowers the peak; the lobes correct this. Each photograph
is also predicted from the others. This shows the error of the finish between two photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from coupole.errors import InputError
from coupole.exchange.bracket import half_angle_table
from coupole.exchange.bracket.finish_lobes import Lobes, fitted_lobes

Array = NDArray[np.float64]
_LEAST_COSINE = 0.12
_MOST_SAMPLES = 60_000
_SMOOTHNESSES = (2e-4, 2e-3, 2e-2)
_ROUNDS = 2
"""Rounds of the correction for the mean over a pixel, which lowers a peak; each round uses the lobes of the one
before."""
_GAUSS = ((-np.sqrt(0.15), 5.0 / 18.0), (0.0, 8.0 / 18.0), (np.sqrt(0.15), 5.0 / 18.0))
"""Nodes and weights of Gauss' rule over an interval of length 1."""
_NEAREST = 0.005
"""Share of a photograph's samples that count as its peak."""
_FEWEST = 1000
_AT_ONCE = 100_000


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Lit(_Model):
    """A photograph of the sphere under one distant light."""

    path: Path
    """OpenEXR with R, G, B, as `coupole bracket` writes it."""
    to_light: tuple[float, float, float]
    """Direction to the light: x to the right of the picture, y up, z to the camera."""


class White(_Model):
    """A white surface at the point of the sphere that faces the light, photographed in the same way."""

    values: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.99


class SphereSample(_Model):
    """A sphere in photographs from so far away that the projection is orthographic."""

    photographs: Annotated[tuple[Lit, ...], Field(min_length=1)]
    centre_px: tuple[float, float]
    """Column and row; the middle of the first pixel is 0, 0."""
    radius_px: Annotated[float, Field(gt=3)]
    white: White


@dataclass(frozen=True)
class Samples:
    """Directions of pixels in the frames of their normals, and their reflectance."""

    ways_in: Array
    """[n, 3]."""
    ways_out: Array
    f: Array
    """[n, 3] 1/sr."""
    photograph: NDArray[np.intp]
    """[n] number of the photograph of each sample."""
    places: Array
    """[n, 2] middles of the pixels: right and up from the sphere's centre, in radii."""
    to_lights: Array
    """[photographs, 3], unit vectors in the camera's frame."""
    pixel_radii: float
    """Side of a pixel, in radii of the sphere."""

    def of(self, picks: NDArray[np.intp]) -> Samples:
        """Return the samples with these numbers."""
        arrays = {
            name: getattr(self, name)[picks] for name in ("ways_in", "ways_out", "f", "photograph", "places")
        }
        return replace(self, **arrays)


@dataclass(frozen=True)
class LeftOutPrediction:
    """A test of the table: one photograph, predicted by all others."""

    photograph: int
    incidence_deg: float
    """Half of the angle between light and camera, which is the incidence at the peak."""
    nearest_to_peak_deg: float
    """Half angle of the photograph's sample that is nearest to the peak."""
    median_miss: float
    """Median relative error of its samples."""
    peak_miss: float
    """Median relative error, with sign, of the samples nearest to the peak."""


@dataclass(frozen=True)
class Finish:
    """A finish: lobes multiplied by the exponential of a table of `half_angle_table`."""

    lobes: Lobes
    log_correction: Array
    """[entries, 3]."""
    left_out: tuple[LeftOutPrediction, ...]


def samples_of(sample: SphereSample, pictures: Sequence[NDArray[np.float32]]) -> Samples:
    """Take samples from linear pictures [h, w, 3], NaN where a pixel is not known. Samples near the horizon of
    light or camera are left out.

    Raises InputError if the sphere is not in the picture, or if too few pixels are usable.
    """
    parts = []
    to_lights = np.array([lit.to_light for lit in sample.photographs])
    to_lights /= np.linalg.norm(to_lights, axis=1, keepdims=True)
    for number, (lit, picture) in enumerate(zip(sample.photographs, pictures, strict=True)):
        rows, columns = picture.shape[:2]
        u, v = sample.centre_px
        if min(u, v, columns - 1 - u, rows - 1 - v) < sample.radius_px - 0.5:
            raise InputError(
                f"{lit.path}: expected all of the sphere in the picture; correct centre_px or radius_px"
            )
        y, x = np.mgrid[:rows, :columns]
        x, y = (x - u) / sample.radius_px, (v - y) / sample.radius_px
        places = np.stack([x, y], axis=2)[x**2 + y**2 < 1.0]
        values = picture[x**2 + y**2 < 1.0]
        ways_in, ways_out = _ways(places, to_lights[number])
        f = values / np.asarray(sample.white.values) * sample.white.reflectance / np.pi / ways_in[:, 2:]
        good = (ways_in[:, 2] > _LEAST_COSINE) & (ways_out[:, 2] > _LEAST_COSINE)
        good &= np.isfinite(f).all(axis=1) & (f > 0.0).all(axis=1)
        numbers = np.full(np.count_nonzero(good), number)
        parts.append((ways_in[good], ways_out[good], f[good], numbers, places[good]))
    ways_in, ways_out, f, photograph, places = (np.concatenate(part) for part in zip(*parts, strict=True))
    if len(f) < _FEWEST:
        raise InputError(
            f"sphere: expected at least {_FEWEST} lit pixels, neither dark nor saturated; found {len(f)}"
        )
    return Samples(ways_in, ways_out, f, photograph, places, to_lights, 1.0 / sample.radius_px)


def finish_of(samples: Samples) -> Finish:
    """Fit lobes, then a table of their residual. The smoothness of the table is the one that predicts left-out
    photographs best.
    """
    samples = samples.of(np.random.default_rng(1).permutation(len(samples.f))[:_MOST_SAMPLES])
    ways_in, ways_out, of_photograph = samples.ways_in, samples.ways_out, samples.photograph
    lobes = fitted_lobes(ways_in, ways_out, samples.f)
    for _ in range(_ROUNDS):
        f = samples.f * at_middles_over_means(samples, lobes)
        lobes = fitted_lobes(ways_in, ways_out, f, (float(lobes.alphas[0]),))
    design = half_angle_table.interpolation(ways_in, ways_out)
    log_misses = np.log(f / lobes.reflectance(ways_in, ways_out))
    guesses = {
        smoothness: _left_out(design, log_misses, of_photograph, smoothness) - log_misses
        for smoothness in _SMOOTHNESSES
    }
    smoothness = min(guesses, key=lambda candidate: float(np.median(np.abs(guesses[candidate]))))
    theta_h, theta_d, _ = half_angle_table.half_coordinates(ways_in, ways_out)
    off = np.expm1(guesses[smoothness])
    predictions = [
        _prediction(number, off[of_photograph == number], theta_h, theta_d, of_photograph == number)
        for number in np.unique(of_photograph)
    ]
    return Finish(lobes, half_angle_table.smooth_table(design, log_misses, smoothness), tuple(predictions))


def at_middles_over_means(samples: Samples, lobes: Lobes) -> Array:
    """[n, 3] the radiance of the lobes at each pixel's middle, divided by their mean radiance in the pixel.

    A pixel near the sphere's edge covers many normals: a peak at 60 degrees is lowered four times as much as at 0.
    """
    mean = np.zeros_like(samples.f)
    for number, to_light in enumerate(samples.to_lights):
        is_own = samples.photograph == number
        for right, share_right in _GAUSS:
            for up, share_up in _GAUSS:
                places = samples.places[is_own] + samples.pixel_radii * np.array([right, up])
                ways_in, ways_out = _ways(places, to_light)
                lit = np.maximum(ways_in[:, 2:], 0.0) * (ways_out[:, 2:] > 0.0)
                mean[is_own] += share_right * share_up * lit * lobes.reflectance(ways_in, ways_out)
    return lobes.reflectance(samples.ways_in, samples.ways_out) * samples.ways_in[:, 2:] / mean


def _left_out(design: Any, log_misses: Array, of_photograph: NDArray[np.intp], smoothness: float) -> Array:
    """Predict each photograph's samples by a table of the other photographs. If there is only one photograph, the
    lobes alone predict them."""
    guess = np.zeros_like(log_misses)
    numbers = np.unique(of_photograph)
    for number in numbers if len(numbers) > 1 else []:
        is_own = of_photograph == number
        guess[is_own] = design[is_own] @ half_angle_table.smooth_table(
            design[~is_own], log_misses[~is_own], smoothness
        )
    return guess


def _prediction(
    number: int, off: Array, theta_h: Array, theta_d: Array, is_own: NDArray[np.bool_]
) -> LeftOutPrediction:
    near = theta_h[is_own] <= np.quantile(theta_h[is_own], _NEAREST)
    return LeftOutPrediction(
        photograph=int(number),
        incidence_deg=float(np.degrees(np.median(theta_d[is_own]))),
        nearest_to_peak_deg=float(np.degrees(theta_h[is_own].min())),
        median_miss=float(np.median(np.abs(off))),
        peak_miss=float(np.median(off[near])),
    )


def finish_function(finish: Finish) -> Callable[[Array, Array], Array]:
    """The finish as a function of directions [n, 3]; it is computed in parts that fit into memory."""

    def reflectance(ways_in: Array, ways_out: Array) -> Array:
        blocks = []
        for at in range(0, len(ways_in), _AT_ONCE):
            part = ways_in[at : at + _AT_ONCE], ways_out[at : at + _AT_ONCE]
            correction = np.exp(half_angle_table.interpolation(*part) @ finish.log_correction)
            blocks.append(finish.lobes.reflectance(*part) * correction)
        return np.concatenate(blocks)

    return reflectance


def misses(samples: Samples, finish: Finish) -> tuple[float, float]:
    """Median and 95 % quantile of the relative differences between finish and samples."""
    off = np.abs(finish_function(finish)(samples.ways_in, samples.ways_out) / samples.f - 1.0)
    median, most = np.quantile(off, [0.5, 0.95])
    return float(median), float(most)


def _ways(places: Array, to_light: Array) -> tuple[Array, Array]:
    """Directions to the light and to the camera [n, 3] at places [n, 2] of the sphere, each in a frame of the
    normal there; outside the sphere, the directions at its edge."""
    radius = np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1.0)
    up = np.sqrt(np.maximum(1.0 - np.sum(places**2, axis=1, keepdims=True), 0.0))
    frames = _frames(np.concatenate([places / radius, up], axis=1))
    return frames @ to_light, frames @ np.array([0.0, 0.0, 1.0])


def _frames(normals: Array) -> Array:
    """[n, 3, 3] frames, whose rows are two tangents and the normal."""
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(least, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=1)

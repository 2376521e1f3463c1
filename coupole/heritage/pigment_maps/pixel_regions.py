"""Regions of like spectra in an image: pixels that differ by little more than the image's own noise.

Noise is estimated from differences of neighbours. Spectra are divided by it, and reduced to the components whose
variance exceeds the variance of noise (Green et al., IEEE Trans. Geosci. Remote Sens. 26, 65, 1988). Groups are
split in two along their widest direction until none is wider than noise, or there are enough; then Lloyd's
iteration (IEEE Trans. Inf. Theory 28, 129, 1982) settles all of them together. The result does not depend on
chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array

_LEAST_NOISE = 2e-4
"""Standard deviation of reflectance below which no difference is believed."""
_ABOVE_NOISE = 1.5
_MOST_COMPONENTS = 30
_WIDER_THAN_NOISE = 4.0
"""Variance along the widest direction of a group, as a multiple of the variance of noise, above which the group
is split.
"""
_SHADING = 0.05
"""Relative standard deviation of light and relief in a group, which is no reason to split it."""
_LEAST_PIXELS = 10
_SPLITS, _SETTLINGS = 12, 30
_FAR_QUANTILE, _FAR_FACTOR, _FAR_AT_LEAST = 0.999, 1.5, 4.0


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of an image, found in a sample of its pixels, in bands that all pixels have."""

    mean: Array
    """[bands] reflectance of the sample."""
    noise: Array
    """[bands] standard deviation of a pixel's noise."""
    basis: Array
    """[bands, components] orthonormal basis of spectra that were divided by the noise."""
    centres: Array
    """[regions, components]"""
    farthest: float
    """Mean square distance from the centre, in units of noise, beyond which a pixel belongs to no region."""

    def places(self, reflectance: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_], Array]:
        """Return, for pixels [n, bands]: the nearest region [n], whether the pixel is like it [n], and the spectra
        [n, bands] without noise outside the components."""
        in_noise = (reflectance - self.mean) / self.noise
        scores = in_noise @ self.basis
        squares = _squares(scores, self.centres)
        nearest = squares.argmin(axis=1)
        beyond = (in_noise**2).sum(axis=1) - (scores**2).sum(axis=1)
        distance = (squares[np.arange(len(nearest)), nearest] + np.maximum(beyond, 0.0)) / len(self.mean)
        return nearest, distance <= self.farthest, self.mean + (scores @ self.basis.T) * self.noise


def noise_of_neighbours(left_pixels: Array, right_pixels: Array) -> Array:
    """[bands] standard deviation of noise from pairs of neighbours [n, bands], by the median of their differences,
    so that edges between areas count little."""
    apart = np.abs(left_pixels - right_pixels)
    noise: Array = np.maximum(1.4826 * np.median(apart, axis=0) / np.sqrt(2.0), _LEAST_NOISE)
    return noise


def find_regions(sample: Array, noise: Array, most: int) -> Regions:
    """Find at most `most` regions in a sample of pixels [n, bands]."""
    mean = sample.mean(axis=0)
    in_noise = (sample - mean) / noise
    variances, vectors = np.linalg.eigh(in_noise.T @ in_noise / len(sample))
    keep = np.flatnonzero(variances > _ABOVE_NOISE)[::-1][:_MOST_COMPONENTS]
    basis = vectors[:, keep if len(keep) else [-1]]
    scores = in_noise @ basis
    groups = _split(scores, (mean / noise) @ basis, most)
    centres = _settle(scores, np.stack([scores[rows].mean(axis=0) for rows in groups]))
    beyond = (in_noise**2).sum(axis=1) - (scores**2).sum(axis=1)
    distance = (_squares(scores, centres).min(axis=1) + np.maximum(beyond, 0.0)) / len(mean)
    farthest = max(_FAR_AT_LEAST, _FAR_FACTOR * float(np.quantile(distance, _FAR_QUANTILE)))
    return Regions(mean, noise, basis, centres, farthest)


def _split(scores: Array, origin: Array, most: int) -> list[NDArray[np.intp]]:
    """Return the rows of each group. `origin` [components] is the spectrum at scores of zero."""

    def group(rows: NDArray[np.intp]) -> _Group:
        apart = _without_shading(scores[rows], origin)
        variances, vectors = np.linalg.eigh(apart.T @ apart / max(len(rows) - 1, 1))
        return _Group(rows, apart, float(variances[-1]), vectors[:, -1])

    waiting = [group(np.arange(len(scores)))]
    narrow_groups: list[NDArray[np.intp]] = []
    while waiting and len(waiting) + len(narrow_groups) < most:
        place = max(range(len(waiting)), key=lambda at: waiting[at].variance * len(waiting[at].rows))
        widest = waiting.pop(place)
        half = _first_half(widest) if widest.variance > _WIDER_THAN_NOISE else None
        if half is None:
            narrow_groups.append(widest.rows)
        else:
            waiting += [group(widest.rows[half]), group(widest.rows[~half])]
    return narrow_groups + [group_.rows for group_ in waiting]


def _without_shading(scores: Array, origin: Array) -> Array:
    """Return a group's differences from its mean; those that only make the whole spectrum lighter or darker count
    as noise of 5 %."""
    centre = scores.mean(axis=0)
    spectrum = origin + centre
    size = float(np.linalg.norm(spectrum))
    apart: Array = scores - centre
    if size > 0.0:
        along = spectrum / size
        apart -= (1.0 - 1.0 / np.hypot(1.0, _SHADING * size)) * np.outer(apart @ along, along)
    return apart


@dataclass(frozen=True, eq=False)
class _Group:
    rows: NDArray[np.intp]
    apart: Array
    """Differences from its mean, without shading."""
    variance: float
    """Along its widest direction."""
    direction: Array


def _first_half(group: _Group) -> NDArray[np.bool_] | None:
    """Return which of a group's rows belong to the first half; None if a half would be too small."""
    first = group.apart @ group.direction > 0.0
    for _ in range(_SPLITS):
        if not _LEAST_PIXELS <= first.sum() <= len(first) - _LEAST_PIXELS:
            return None
        centres = np.stack([group.apart[first].mean(axis=0), group.apart[~first].mean(axis=0)])
        nearer = _squares(group.apart, centres).argmin(axis=1) == 0
        if np.array_equal(nearer, first):
            break
        first = nearer
    return first if _LEAST_PIXELS <= first.sum() <= len(first) - _LEAST_PIXELS else None


def _settle(scores: Array, centres: Array) -> Array:
    nearest = np.full(len(scores), -1)
    for _ in range(_SETTLINGS):
        new_nearest = _squares(scores, centres).argmin(axis=1)
        if np.array_equal(new_nearest, nearest):
            break
        nearest = new_nearest
        kept_numbers = [number for number in range(len(centres)) if np.any(nearest == number)]
        centres = np.stack([scores[nearest == number].mean(axis=0) for number in kept_numbers])
        nearest = np.searchsorted(kept_numbers, nearest)
    return centres


def _squares(rows: Array, centres: Array) -> Array:
    squares: Array = np.maximum(
        (rows**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * rows @ centres.T, 0.0
    )
    return squares

"""A view under any of its LEDs, and under lights between them, from a few pictures: principal components of its
frames.

The decomposition uses square roots of shares of the camera's range, because photon noise is then the same
everywhere. Each component has a coefficient for each LED and channel. Between LEDs these are interpolated by thin
plates (Ponchio and others, Compact representation of relightable images for the Web, 2018, use Gaussians).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from coupole.reflectance.light_interpolation import weights

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]

PLANES = 27
KERNEL = "thin plate"
_MOST_PLACES = 2000
"""Number of pixels from which components are computed."""
_BAND_ROWS = 256
_APART = 8
"""Every eighth LED is left out to measure the error of interpolation."""


@dataclass(frozen=True)
class LightPlanes:
    """Decomposition over a view's pixels and LEDs: root of the share = `means` + sum of `of_leds` times
    `planes`."""

    planes: NDArray[np.float32]
    """[planes, h, w]"""
    means: Floats
    """[leds, 3]"""
    of_leds: Floats
    """[planes, leds, 3]"""
    missed_between: tuple[float, float]
    """Median and rms error, as shares of the camera's range, under LEDs that were left out and interpolated from
    the others; NaN if there are too few."""

    def bases(self, ways: Floats) -> NDArray[np.float32]:
        """[leds + 4, planes + 1, 3] factors of thin plates r^2 log r of the distances to LEDs, and of 1, x, y, z.

        Under a light from x, y, z, their sum gives the means (first) and the coefficients of the components.
        """
        values = np.concatenate([self.means[None], self.of_leds]).transpose(1, 0, 2)
        count = len(ways)
        tail = np.hstack([np.ones((count, 1)), ways])
        apart = np.linalg.norm(ways[:, None] - ways[None], axis=2)
        system = np.zeros((count + 4, count + 4))
        system[:count, :count] = apart**2 * np.log(np.maximum(apart, 1e-300))
        system[:count, count:], system[count:, :count] = tail, tail.T
        right = np.vstack([values.reshape(count, -1), np.zeros((4, values[0].size))])
        solution = np.linalg.lstsq(system, right, rcond=1e-12)[0]
        bases: NDArray[np.float32] = solution.reshape(count + 4, *values.shape[1:]).astype(np.float32)
        return bases


def light_planes(
    frame: Callable[[int], Picture],
    ways: Floats,
    see: Callable[[int, Picture], None],
    say: Callable[[str, int, int], None],
    planes: int = PLANES,
) -> LightPlanes:
    """Compute the planes of frames [h, w, 3], in shares of the camera's range, under LEDs in the directions `ways`
    [n, 3].

    `frame` reads a frame by its number; each frame is read twice, and passed once to `see`. It needs the memory of
    `planes` pictures of one channel.
    """
    count = len(ways)
    places = None
    roots = np.empty((0, 0, 3))
    for number in range(count):
        picture = frame(number)
        if places is None:
            pixels = picture.shape[0] * picture.shape[1]
            places = np.random.default_rng(1).permutation(pixels)[:_MOST_PLACES]
            roots = np.empty((len(places), count, 3))
        see(number, picture)
        roots[:, number] = np.sqrt(np.maximum(picture.reshape(-1, 3)[places], 0.0))
        say("frames", number + 1, count)
    means = roots.mean(axis=0)
    apart = (roots - means).reshape(len(roots), -1)
    components = _components(apart, min(planes, len(apart), apart.shape[1]))
    of_leds = components.reshape(len(components), count, 3)
    pictures = np.zeros((0, 0, 0), np.float32)
    for number in range(count):
        off = np.sqrt(np.maximum(frame(number), 0.0)) - means[number].astype(np.float32)
        if not pictures.size:
            pictures = np.zeros((len(components), *off.shape[:2]), np.float32)
        turn = of_leds[:, number].astype(np.float32)
        for first in range(0, len(off), _BAND_ROWS):
            band = off[first : first + _BAND_ROWS]
            pictures[:, first : first + _BAND_ROWS] += (turn @ band.reshape(-1, 3).T).reshape(-1, *band.shape[:2])
        say("planes", number + 1, count)
    return LightPlanes(pictures, means, of_leds, _missed_between(roots, ways, planes))


def _components(apart: Floats, count: int) -> Floats:
    """[count, m] orthonormal rows that leave the smallest residual of `apart` [n, m]."""
    low = len(apart) - count
    powers, of_rows = eigh(apart @ apart.T, subset_by_index=(low, len(apart) - 1))
    firm = powers > max(powers.max(), 0.0) * 1e-12
    rows = (of_rows[:, firm].T @ apart)[::-1]
    components: Floats = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    return components


def _missed_between(roots: Floats, ways: Floats, planes: int) -> tuple[float, float]:
    out = np.arange(len(ways)) % _APART == _APART // 2
    if out.sum() < 1 or (~out).sum() < 6:
        return math.nan, math.nan
    training = roots[:, ~out]
    means = training.mean(axis=0)
    apart = (training - means).reshape(len(training), -1)
    components = _components(apart, min(planes, len(apart), apart.shape[1]))
    short = (apart @ components.T @ components).reshape(training.shape) + means
    between = np.einsum("wl,plc->pwc", weights(ways[~out], ways[out], KERNEL), short)
    return error_figures(np.maximum(between, 0.0) ** 2, roots[:, out] ** 2)


def error_figures(computed_values: Floats, measured_values: Floats) -> tuple[float, float]:
    """Median, and root of the mean square, of the differences."""
    off = np.abs(computed_values - measured_values)
    return float(np.median(off)), float(np.sqrt(np.mean(off**2)))

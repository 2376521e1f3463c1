"""Prediction of a picture, and quantities that are known beforehand and predict its error.

Each column is one number for each pixel and channel. Brightness, incidence, highlight, material and nearness to
edges come from the prediction and the materials; the differences among kernels and near pictures, and the kernel's
error for the near pictures themselves, come from the measured lights. The predicted light itself is never used.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance import learned_correction as correction
from coupole.reflectance import light_interpolation
from coupole.reflectance.learned_correction import Strip
from coupole.reflectance.light_gains import GAIN_NEIGHBOURS, gain_between, modelled_values
from coupole.reflectance.light_interpolation import left_without, nearest
from coupole.reflectance.relighting import Interpolation

Floats = NDArray[np.float32]

_VIEW = np.array([0.0, 0.0, 1.0])
_EDGE_PX = 5
"""Width in pixels of the squares in which edges are detected."""
_FLOOR = 2e-4
"""Share of the peak that is added to brightness values before their logarithm is taken."""


@dataclass(frozen=True)
class StripMaterials:
    """Materials of the pixels of a strip; NaN for pixels without material."""

    normals: NDArray[np.float64]
    """[n, 3]"""
    kd: NDArray[np.float64]
    """[n, 3]"""
    ks: NDArray[np.float64]
    """[n, 3]"""
    alpha: NDArray[np.float64]
    residual: NDArray[np.float64]

    def at(self, pixels: slice) -> StripMaterials:
        """Return the materials of some of the pixels."""
        return StripMaterials(*(getattr(self, field.name)[pixels] for field in fields(self)))


@dataclass(frozen=True)
class Foreseen:
    """A predicted picture of a strip, and quantities known beforehand about its error. All are [n, 3]; values are
    in full scales divided by the intensities."""

    values: Floats
    kernel_spread: Floats
    """Range of the kernels' predictions."""
    near_spread: Floats
    """Range of the near pictures."""
    near_miss: Floats
    """Rms error of the kernel for the near pictures, each of which is left out in turn."""
    worst_miss: Floats
    correction: Floats
    """Size of the learnt correction."""
    model_miss: Floats
    """Distance from the prediction to the material's value."""
    edge: Floats
    """Standard deviation of the prediction in a small square."""
    level: Floats
    """Mean of the pixel under all lights."""
    residual: Floats
    """Residual of the pixel's material."""
    incidence: Floats
    """Cosine between normal and light, not below 0."""
    shine: Floats
    """Share of the highlight in the material's value."""
    shade: Floats
    """Prediction as a share of the material's value; it is small in shadows."""
    gain_spread: Floats
    """Range of the gains of the nearest pictures, divided by their median."""

    def regressors(self, peak: float) -> NDArray[np.float64]:
        """[n * 3, columns] regressors from which the scale of the error is predicted log-linearly; `peak` is the
        brightest value of the pictures."""
        bright = (
            self.values, self.kernel_spread, self.near_spread, self.near_miss, self.worst_miss, self.correction,
            self.model_miss, self.edge, self.level,
        )  # fmt: skip
        columns = [np.log(column + _FLOOR * peak) for column in bright]
        shade = np.log(np.clip(self.shade, 0.05, 20.0))
        columns += [np.log(self.residual + 1e-3), self.incidence, self.incidence**2]
        columns += [np.log(self.gain_spread + 0.01), shade, np.abs(shade), np.ones_like(shade)]
        return np.stack(columns, axis=-1).reshape(-1, len(columns)).astype(np.float64)

    def labels(self, peak: float) -> dict[str, NDArray[np.int64]]:
        """Return the strata [n * 3] of each pixel and channel, in the form that `strata.fit_strata` takes."""
        over = self.values + np.float32(0.02 * peak)
        strata = {
            "brightness": np.digitize(self.values / peak, (0.01, 0.03, 0.06, 0.1, 0.2, 0.35, 0.5, 0.75)),
            "incidence": np.digitize(self.incidence, (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 0.95)),
            "highlight": np.digitize(self.shine, (0.02, 0.05, 0.1, 0.2, 0.4)),
            "shadow": np.digitize(self.shade, (0.3, 0.6, 0.8, 0.95, 1.05, 1.2, 1.6)),
            "edge": np.digitize(self.edge / over, (0.02, 0.05, 0.1, 0.2, 0.4)),
            "material": np.digitize(self.level / peak, (0.05, 0.1, 0.2, 0.3, 0.5)),
            "residual": np.digitize(self.residual, (0.005, 0.01, 0.02, 0.04)),
            "near pictures": np.digitize(self.near_spread / over, (0.1, 0.2, 0.4, 0.8, 1.6)),
            "gains": np.digitize(self.gain_spread, (0.02, 0.05, 0.1)),
        }
        for first, second in (("brightness", "edge"), ("brightness", "near pictures"), ("edge", "shadow")):
            strata[f"{first}, {second}"] = 10 * strata[first] + strata[second]
        return {name: stratum.ravel() for name, stratum in strata.items()}


def foresee(
    strip: Strip,
    materials: StripMaterials,
    interpolation: Interpolation,
    directions: NDArray[np.float64],
    direction: NDArray[np.float64],
) -> Foreseen:
    """Predict a strip under a distant light in the unit vector `direction` [3]. `strip` has the values under the
    interpolation's lights, in `directions` [lights, 3], divided by its gains."""
    kernels = correction.all_kernels(interpolation.kernel)
    sight = correction.look(strip, directions, direction, kernels)
    level = strip.level[:, None]
    values = correction.corrected_values(strip, sight, interpolation.network)
    near = nearest(directions, direction, correction.NEAR)
    near_values = strip.values[near]
    sums = _sums(strip, directions, direction, kernels)
    misses = np.stack([_miss(strip, directions, light, kernels[0]) for light in near])
    diffuse, highlight = _diffuse_and_highlight(materials, direction)
    model_values = (diffuse + highlight).astype(np.float32)
    near_gains = interpolation.gains[near[:GAIN_NEIGHBOURS]]
    gain = np.float32(gain_between(directions, interpolation.gains, direction))

    def wide(column: NDArray[np.floating]) -> Floats:
        return np.broadcast_to(column[:, None], values.shape).astype(np.float32)

    return Foreseen(
        values=gain * values,
        kernel_spread=gain * np.ptp(sums, axis=0),
        near_spread=gain * np.ptp(near_values, axis=0),
        near_miss=gain * np.sqrt(np.mean(misses**2, axis=0)),
        worst_miss=gain * np.abs(misses).max(axis=0),
        correction=gain * np.abs(values - sight.kernel_sum * level),
        model_miss=gain * np.abs(values - model_values),
        edge=gain * _deviation_around(strip, values),
        level=wide(strip.level),
        residual=wide(materials.residual),
        incidence=wide(np.maximum(materials.normals @ direction, 0.0)),
        shine=(highlight / np.maximum(model_values, 1e-9)).astype(np.float32),
        shade=(values / np.maximum(model_values, 1e-9)).astype(np.float32),
        gain_spread=np.full(values.shape, np.ptp(near_gains) / gain, np.float32),
    )


def _sums(
    strip: Strip, directions: NDArray[np.float64], direction: NDArray[np.float64], kernels: tuple[str, ...]
) -> Floats:
    """[kernels, n, 3] weighted sums of the measured pictures."""
    rows = [light_interpolation.weights(directions, direction[None], kernel)[0] for kernel in kernels]
    sums = np.stack(rows).astype(np.float32) @ strip.values.reshape(len(directions), -1)
    return np.asarray(sums.reshape(len(kernels), *strip.values.shape[1:]), dtype=np.float32)


def _miss(strip: Strip, directions: NDArray[np.float64], light: int, kernel: str) -> Floats:
    """[n, 3] error of the kernel at a measured light that is left out together with its nearest neighbour."""
    other_lights = left_without(directions, light, correction.LEFT_OUT_WITH)
    row = light_interpolation.weights(directions[other_lights], directions[light][None], kernel)[0]
    whole = np.zeros(len(directions), np.float32)
    whole[other_lights] = row
    kernel_sum = whole @ strip.values.reshape(len(directions), -1)
    return np.asarray(kernel_sum.reshape(strip.values.shape[1:]) - strip.values[light], dtype=np.float32)


def _diffuse_and_highlight(
    materials: StripMaterials, direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[n, 3] diffuse part and highlight of materials, without shadows."""
    half = direction + _VIEW
    half /= np.linalg.norm(half)
    black, white = np.zeros(len(materials.alpha)), np.ones(len(materials.alpha))
    shapes = modelled_values(materials.normals, black, white, materials.alpha, direction[None], half[None], _VIEW)
    incidence = np.maximum(materials.normals @ direction, 0.0)[:, None]
    return incidence * materials.kd, shapes * materials.ks


def _deviation_around(strip: Strip, values: Floats) -> Floats:
    """[n, 3] standard deviation in squares of `_EDGE_PX`."""
    mean = correction.mean_around(strip.mask, values, _EDGE_PX)
    square = correction.mean_around(strip.mask, values**2, _EDGE_PX)
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)), dtype=np.float32)

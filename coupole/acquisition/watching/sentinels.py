"""Sentinels: frames of the same LEDs that are taken again and again. Each is compared with the first frame of its
LED.

Between two frames of one light, the picture may change by a gain, by a displacement, and in places. Gain and
displacement come from the linear model of Lucas and Kanade (IJCAI 1981), by weighted least squares:

    after - before = gain mean - dx d(mean)/dx - dy d(mean)/dy
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.watching.camera_noise import CameraNoise
from coupole.acquisition.watching.dark_frames import tile_sums
from coupole.acquisition.watching.frame_look import FrameLook
from coupole.acquisition.watching.neighbour_lights import scatter_of

Floats = NDArray[np.float64]
_TUKEY, _ROUNDS = 4.685, 8
_DIM = 0.3
"""Share of the picture's mean below which a place is dim."""
_FEWEST_BINS, _LIT_SIGMAS = 64, 5.0
"""Number of bins that must be lit, and the signal in standard deviations from which a bin counts as lit."""


@dataclass(frozen=True)
class Change:
    """Change of one light's picture."""

    gain: float
    """Logarithm of the change of brightness."""
    gain_sigma: float
    shift_bins: Floats
    """[2] displacement of the picture, right and down."""
    shift_sigma_bins: float
    tile_shares: Floats
    """[tiles, tiles] change of brightness in places, without gain and displacement. It is a share of the place's
    light, or in dim places a share of a part of the picture's mean."""
    tile_sigmas: Floats
    """[tiles, tiles] standard deviation of that change by noise."""
    by_shift: float
    """Sum of squares, in units of noise, that the displacement explains."""
    by_places: float
    """The same for a change in places alone."""


def change_between(before: FrameLook, after: FrameLook, noise: CameraNoise) -> Change | None:
    """Return the change between two frames of one light; None if nearly all bins are clipped or dark."""
    is_known = ~(before.is_clipped | after.is_clipped)
    mean_dn = 0.5 * (before.mean_dn.astype(float) + after.mean_dn)
    down, right = np.gradient(mean_dn)
    variance = 2.0 * noise.variance_dn2(mean_dn)
    difference = after.mean_dn.astype(float) - before.mean_dn
    if np.count_nonzero(is_known & (mean_dn > _LIT_SIGMAS * np.sqrt(variance))) < _FEWEST_BINS:
        return None
    columns = np.stack([mean_dn, -right, -down], axis=-1)
    gain, gain_sigma = _robust_gain(columns[is_known], difference[is_known], variance[is_known])
    weight = np.where(is_known, 1.0 / variance, 0.0)
    beyond_gain = np.where(is_known, difference - gain * mean_dn, 0.0)
    shift, covariance = _shift(columns[..., 1:], beyond_gain, weight)
    remainder_dn = np.where(is_known, beyond_gain - columns[..., 1:] @ shift, 0.0)
    expected_dn = np.where(is_known, before.mean_dn * (1.0 + gain), 0.0)
    tiles_dn, tile_sigmas_dn = tile_sums(expected_dn), np.sqrt(tile_sums(np.where(is_known, variance, 0.0)))
    measure = np.maximum(tiles_dn, _DIM * float(tiles_dn.mean()))
    plain = float(np.sum(weight * beyond_gain**2))
    return Change(
        gain,
        gain_sigma,
        shift,
        float(np.sqrt(np.trace(covariance))),
        tile_sums(remainder_dn) / measure,
        tile_sigmas_dn / measure,
        plain - float(np.sum(weight * remainder_dn**2)),
        _explained_by_places(beyond_gain, expected_dn, weight),
    )


def _robust_gain(columns: Floats, values: NDArray[np.floating], variance: Floats) -> tuple[float, float]:
    """Return the gain, which belongs to the first of the columns [n, 3], and its standard deviation. Changes in
    places hardly count."""
    weight = 1.0 / variance
    for _ in range(_ROUNDS):
        weighted_columns = columns * weight[:, None]
        normal = weighted_columns.T @ columns
        normal += np.eye(len(normal)) * 1e-9 * np.trace(normal)
        solution = np.linalg.solve(normal, weighted_columns.T @ values)
        z = (values - columns @ solution) / np.sqrt(variance)
        scale = max(1.0, scatter_of(z))
        weight = np.clip(1.0 - (z / (_TUKEY * scale)) ** 2, 0.0, None) ** 2 / variance
    return float(solution[0]), float(np.sqrt(np.linalg.inv(normal)[0, 0])) * scale


def _shift(columns: Floats, values: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the displacement [2] by the gradients [rows, columns, 2], and the covariance [2, 2] of this fit. Only
    edges show a displacement, so none of them is left out."""
    weighted_columns = columns * weight[..., None]
    normal = np.einsum("rci,rcj->ij", weighted_columns, columns)
    normal += np.eye(2) * (1e-9 * np.trace(normal) + 1e-12)
    shift: Floats = np.linalg.solve(normal, np.einsum("rci,rc->i", weighted_columns, values))
    remainder = float(np.sum(weight * (values - columns @ shift) ** 2)) / max(1, int(np.count_nonzero(weight)))
    return shift, np.asarray(np.linalg.inv(normal)) * max(1.0, remainder)


def _explained_by_places(values: Floats, foreseen_dn: Floats, weight: Floats) -> float:
    """Return the sum of squares that a change of each tile explains. The change is in proportion to the tile's
    light, or even."""
    tiny = 1e-30
    in_proportion = tile_sums(weight * values * foreseen_dn) ** 2 / (tile_sums(weight * foreseen_dn**2) + tiny)
    evenly = tile_sums(weight * values) ** 2 / (tile_sums(weight) + tiny)
    return float(np.maximum(in_proportion, evenly).sum())

"""Two lobes of facets over a diffuse body: a first model of a finish, which a table then corrects.

The wider lobe has GGX's distribution. The narrower one has a tail between the tails of GGX and a Gaussian: D is
proportional to (1 + tan^2(theta_h)/(alpha^2 (g - 1)))^-g / cos^4(theta_h), GGX for g = 2, Beckmann for large g
(Student's distribution of slopes; Ribardiere and others, Computer Graphics Forum 36, 2017). Shadowing is Smith's
for GGX. The rise towards grazing angles is Schlick's, minus the dip that metals have before it (Lazanyi and
Szirmay-Kalos, "Fresnel term approximations for metals", WSCG 2005). The fit is a robust one of log f. The model
need not be exact, because the table takes its residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.brdf import half_vector

Array = NDArray[np.float64]
_GGX_TAIL = 2.0
_STARTS = (0.06, 0.2, 0.5)
"""Alphas of the narrow lobe with which the fit begins; the wide lobe begins with three times this alpha."""
_FIT_SAMPLES, _STEPS = 1500, 60
_TOLERATED = 0.1
"""Difference of log f above which a sample has less weight."""
_LEAST_FRESNEL = 0.05
_CELL_DEG, _CELLS_H = 3.0, 64
"""Samples are drawn evenly over cells of difference and half angle, because a peak has few pixels."""


@dataclass(frozen=True)
class Lobes:
    """Parameters of the two lobes."""

    alphas: Array
    """[2], narrow and wide."""
    tail: float
    """g of the narrow lobe, above 1.5."""
    diffuse: Array
    """[3], reflectance of the body."""
    strengths: Array
    """[2, 3] reflectance of the lobes at normal incidence."""
    rise: Array
    """[3] increase of the lobes at grazing incidence, as a share of their strength."""
    dip: Array
    """[3] factor of the dip c (1 - c)^6, where c is the cosine to the half vector."""

    def reflectance(self, ways_in: Array, ways_out: Array) -> Array:
        """1/sr [n, 3] for unit directions [n, 3] above the surface."""
        half, cosine = half_vector(ways_in, ways_out)
        c = cosine[:, None]
        fresnel = 1.0 + self.rise * (1.0 - c) ** 5 - self.dip * c * (1.0 - c) ** 6
        narrow = _lobe(ways_in, ways_out, half[:, 2], self.alphas[0], self.tail)[:, None] * self.strengths[0]
        wide = _lobe(ways_in, ways_out, half[:, 2], self.alphas[1], _GGX_TAIL)[:, None] * self.strengths[1]
        return np.asarray(self.diffuse / np.pi + (narrow + wide) * np.maximum(fresnel, _LEAST_FRESNEL))


def fitted_lobes(ways_in: Array, ways_out: Array, f: Array, alphas: tuple[float, ...] = _STARTS) -> Lobes:
    """The lobes nearest to samples of f [n, 3], 1/sr, in logarithms. The fit begins at each of `alphas`."""
    from scipy.optimize import least_squares

    picks = _even_picks(ways_in, ways_out)
    ways_in, ways_out, logs = ways_in[picks], ways_out[picks], np.log(f[picks])
    least = np.array([np.log(0.01), -3.0, np.log(0.01)] + [-14.0] * 15)
    most = np.array([0.0, 4.0, np.log(2.0)] + [4.0] * 15)
    body = np.log(np.quantile(f, 0.01, axis=0) * np.pi)

    def left_over(parameters: Array) -> Array:
        return np.asarray((np.log(_lobes_of(parameters).reflectance(ways_in, ways_out)) - logs).ravel())

    fits = []
    for alpha in alphas:
        levels = [np.full(3, np.log(level)) for level in (0.5, 0.2, 0.1, 0.1)]
        start = np.concatenate([[np.log(alpha), 0.0, np.log(3.0 * alpha)], body, *levels])
        start = np.clip(start, least + 0.01, most - 0.01)
        bounds = (least, most)
        fits.append(
            least_squares(left_over, start, loss="soft_l1", f_scale=_TOLERATED, bounds=bounds, max_nfev=_STEPS)
        )
    return _lobes_of(min(fits, key=lambda fit: float(fit.cost)).x)


def _lobes_of(parameters: Array) -> Lobes:
    narrow, tail, wide = np.exp(parameters[:3])
    diffuse, first, rise, second, dip = np.exp(parameters[3:].reshape(5, 3))
    return Lobes(np.array([narrow, wide]), 1.5 + float(tail), diffuse, np.stack([first, second]), rise, dip)


def _lobe(ways_in: Array, ways_out: Array, half_z: Array, alpha: float, tail: float) -> Array:
    """[n] D G/(4 z_i z_o). D is normalised only for the tail of GGX; for other tails the lobe's strength
    compensates."""
    alpha2 = alpha**2
    z_h = np.maximum(half_z, 1e-6)
    z_i, z_o = np.maximum(ways_in[:, 2], 1e-9), np.maximum(ways_out[:, 2], 1e-9)
    d = (1.0 + (1.0 / z_h**2 - 1.0) / (alpha2 * (tail - 1.0))) ** -tail / (np.pi * alpha2 * z_h**4)
    shadowing = z_o * np.sqrt(alpha2 + (1.0 - alpha2) * z_i**2) + z_i * np.sqrt(alpha2 + (1.0 - alpha2) * z_o**2)
    return np.asarray(d * 0.5 / shadowing)


def _even_picks(ways_in: Array, ways_out: Array) -> NDArray[np.intp]:
    half, cosine = half_vector(ways_in, ways_out)
    theta_h = np.arccos(np.clip(half[:, 2], -1.0, 1.0))
    theta_d_deg = np.degrees(np.arccos(cosine))
    across = np.minimum((np.sqrt(theta_h / (0.5 * np.pi)) * _CELLS_H).astype(int), _CELLS_H - 1)
    cell = np.round(theta_d_deg / _CELL_DEG).astype(int) * _CELLS_H + across
    _, of_cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    weight = 1.0 / count[of_cell]
    size = min(_FIT_SAMPLES, len(weight))
    return np.random.default_rng(1).choice(len(weight), size, replace=False, p=weight / weight.sum())

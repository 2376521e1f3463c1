"""The light over a chart in a plain picture without a white card. It is found from the patches, together with the
matrix.

Light and the lens's fall-off are taken as one smooth factor, exp(sum of t_k f_k(x, y)), of all three channels. Its
t_k and the matrix's coefficients together minimise the sum of squares of CIEDE2000 (after Finlayson, Gong and
Fisher, Color homography: theory and applications, IEEE Trans. PAMI 41, 2019, where each patch has its own factor).
Errors of the patches' colours that the matrix cannot follow count as noise of this adjustment. The noise differs
between patches, and between lightness, chroma and hue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coupole.calibration.colour.colorimetry import D50_WHITE, de00_parts, lab_of
from coupole.calibration.colour.colour_profile import Balanced, fit_profile
from coupole.calibration.rotations import Floats

_LEAST_FOR_CURVES = 18
"""Least number of patches for a light with curvature. With fewer patches the light is a slope."""
_MOST = 0.7
"""Largest t_k in absolute value, as a natural logarithm."""


@dataclass(frozen=True)
class FoundLight:
    """The smooth factor of a picture's light, in natural logarithms."""

    terms: Floats
    """[n] t_k."""
    covariance: Floats
    """[n, n] covariance of the terms."""
    basis: Floats
    """[patches, n] f_k at the patches."""

    def factor(self) -> Floats:
        """Factor [patches] of the light at the patches. The mean of its logarithms is 0."""
        return np.asarray(np.exp(self.basis @ self.terms))

    def effects(self) -> Floats:
        """Relative changes [patches, n] of signals by one standard uncertainty of each of n independent errors."""
        values, directions = np.linalg.eigh(self.covariance)
        return np.asarray(self.basis @ (directions * np.sqrt(np.maximum(values, 0.0))))

    @property
    def span(self) -> tuple[float, float]:
        """Largest factor over the smallest, minus 1, and the standard uncertainty of this difference."""
        logarithm = self.basis @ self.terms
        across = self.basis[int(np.argmax(logarithm))] - self.basis[int(np.argmin(logarithm))]
        return float(np.exp(np.ptp(logarithm)) - 1.0), float(np.sqrt(across @ self.covariance @ across))


def light_basis(centres: Floats) -> Floats:
    """Return [patches, n] for patches at [patches, 2]: two slopes, and three curvatures if there are enough
    patches. Each has a mean of 0 over the patches. For a chart of one row, the slope across the row is not
    determined."""
    middle, half = (centres.max(axis=0) + centres.min(axis=0)) / 2.0, np.ptp(centres, axis=0) / 2.0
    x, y = ((centres - middle) / np.where(half > 0.0, half, 1.0)).T
    shapes = [x, y] if len(centres) < _LEAST_FOR_CURVES else [x, y, x * x, x * y, y * y]
    basis = np.column_stack([shape - shape.mean() for shape in shapes if np.ptp(shape) > 0.0])
    kept_functions: list[int] = []
    for n in range(basis.shape[1]):  # two rows have no curvature of their own
        if np.linalg.matrix_rank(basis[:, [*kept_functions, n]]) > len(kept_functions):
            kept_functions.append(n)
    return basis[:, kept_functions]


def find_light(patch_signals: Balanced, basis: Floats, at: Floats | None = None) -> FoundLight:
    """Find the light of patches whose signals are not yet divided by it. `at` [m, n] are the functions at the
    places where the light is wanted; the default is `basis` [patches, n]. Raises InputError like `fit_profile`."""
    from scipy.optimize import least_squares

    lab = lab_of(patch_signals.xyz)
    first = fit_profile(patch_signals, "matrix").coefficients
    count = basis.shape[1]

    def misses(unknown: Floats) -> Floats:
        light = np.exp(basis @ unknown[:count])
        evenly_lit = replace(patch_signals, signal=patch_signals.signal / light[:, None])
        free = unknown[count:].reshape(3, 2)
        matrix = np.column_stack([free, D50_WHITE - free.sum(axis=1)])
        return de00_parts(lab_of(evenly_lit.signal / evenly_lit.white_signal() @ matrix.T), lab).ravel()

    start = np.concatenate([np.zeros(count), first[:, :2].ravel()])
    bounds = np.full(len(start), np.inf)
    bounds[:count] = _MOST
    fit = least_squares(misses, start, bounds=(-bounds, bounds), x_scale="jac")
    covariance = _robust_covariance(fit.jac, fit.fun)
    return FoundLight(fit.x[:count], np.asarray(covariance[:count, :count]), basis if at is None else at)


def _robust_covariance(design: Floats, residuals: Floats) -> Floats:
    """Return the covariance [unknowns, unknowns] of a least-squares solution with the derivatives `design` [3
    patches, unknowns].

    The three `residuals` of a patch depend on each other and differ in size. So they are treated as a cluster,
    with the correction CR2 (Bell and McCaffrey, Bias reduction in standard errors for linear regression with
    multi-stage samples, Survey Methodology 28, 2002).
    """
    inverse = np.linalg.inv(design.T @ design)
    by_patch = design.reshape(-1, 3, design.shape[1])
    remaining = np.eye(3) - by_patch @ inverse @ by_patch.transpose(0, 2, 1)
    values, directions = np.linalg.eigh(remaining)
    along = np.einsum("pij,pi->pj", directions, residuals.reshape(-1, 3)) / np.sqrt(np.maximum(values, 1e-6))
    corrected = np.einsum("pij,pj->pi", directions, along)
    scores = np.einsum("pij,pi->pj", by_patch, corrected)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse)

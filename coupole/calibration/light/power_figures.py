"""Errors of LED powers: the errors of each LED alone, and the errors that LEDs share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from coupole.calibration.light.power_suspects import CausesFound
from coupole.calibration.light.tile_parts import PartsFound
from coupole.calibration.rotations import Floats

_NEGLIGIBLE, _MOST_FIGURES = 0.04, 6
"""Share of an LED's own variance that causes may add to it, and greatest number of shared figures for them."""


@dataclass(frozen=True)
class CommonFigures:
    """Errors of all powers: the errors of each LED alone, and the errors that LEDs share."""

    u_own: Floats
    """[leds] relative standard uncertainty."""
    slopes: Floats
    """[leds, c] relative change of each power by one unit of each shared figure."""
    names: tuple[str, ...]
    """Names of the figures of causes, which are the last of the c."""
    covariance: Floats
    """[c, c]."""


def common_figures(
    mean_design: Floats, causes: CausesFound, parts: PartsFound, u_own: Floats, is_used: NDArray[np.bool_]
) -> CommonFigures:
    """Return the shared figures, with few more for a stain, and for the directions in which lobe and drift change
    the powers most. What the other directions do counts as the LEDs' own."""
    count, joint = mean_design.shape[1], causes.error.joint_covariance
    values, vectors = np.linalg.eigh(joint[count:, count:])
    sizes = np.sqrt(np.maximum(values, 0.0))
    patterns, strengths, turns = np.linalg.svd(causes.mean_modes @ (vectors * sizes), full_matrices=False)
    left_variance = np.append(np.cumsum((strengths**2)[::-1])[::-1], 0.0) / max(int(is_used.sum()), 1)
    most = _NEGLIGIBLE * float(np.median(u_own[is_used]) ** 2) if is_used.any() else np.inf
    figure_count = min(int(np.argmax(left_variance <= most)), _MOST_FIGURES)
    by_cause = patterns * strengths
    inverse = np.divide(1.0, sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
    between = joint[:count, count:] @ (vectors * inverse) @ turns[:figure_count].T
    covariance = np.block([[joint[:count, :count], between], [between.T, np.eye(figure_count)]])
    slopes = np.column_stack([-mean_design, -by_cause[:, :figure_count]])
    if parts.u_loss**2 > most:
        slopes = np.column_stack([slopes, np.full(len(slopes), -1.0)])
        covariance = np.asarray(block_diag(covariance, parts.u_loss**2))
    names = tuple(f"cause{number + 1}" for number in range(slopes.shape[1] - count))
    return CommonFigures(
        np.sqrt(u_own**2 + np.sum(by_cause[:, figure_count:] ** 2, axis=1)), slopes, names, covariance
    )

"""Quality of a fit's predictions for views that it did not have. Each view is left out in turn, without a new fit.

Let H be the part of the hat matrix that belongs to a view. If the view is left out, its residuals are (I - H)^-1
r, and their covariance is (I - H)^-1 (Allen's PRESS, Technometrics 16, 1974, for blocks). Quantities that only the
view itself determines, such as the board's pose in it, do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration.adjustment import Block
from coupole.calibration.rotations import Floats

_OWN = 1e-6
"""Least redundancy at which a direction of a view's residuals is used. A direction with less redundancy is
determined by the view alone."""


@dataclass(frozen=True)
class LeftOut:
    """Predictions of the views."""

    ratios: Floats
    """[views] root mean square of the prediction error divided by its standard uncertainty; about 1."""
    off: Floats
    """[views] root mean square of the group's prediction errors, divided by the stated noise."""

    @property
    def ratio(self) -> float:
        """Root mean square over all views of the prediction error divided by its standard uncertainty."""
        return float(np.sqrt(np.mean(self.ratios**2)))


def left_out(
    views: Sequence[Sequence[int]],
    blocks: Sequence[Block],
    weights: Sequence[Floats],
    factors: Floats,
    covariance: Floats,
    group: int = 0,
) -> LeftOut:
    """Return the predictions. `views` are the numbers of each view's blocks; `covariance` is the covariance of all
    parameters, with these noises."""
    ratios, off = np.zeros(len(views)), np.zeros(len(views))
    for number, members in enumerate(views):
        columns = np.unique(np.concatenate([blocks[i].columns for i in members]))
        jacobians, residuals, of_group = [], [], []
        for i in members:
            block, keep = blocks[i], weights[i] > 0
            jacobian = np.zeros((int(keep.sum()), len(columns)))
            jacobian[:, np.searchsorted(columns, block.columns)] = block.jacobian[keep] / factors[block.group]
            jacobians.append(jacobian)
            residuals.append(block.residuals[keep] / factors[block.group])
            of_group.append(np.full(len(jacobian), block.group == group))
        jacobian, residual = np.concatenate(jacobians), np.concatenate(residuals)
        hat = jacobian @ covariance[np.ix_(columns, columns)] @ jacobian.T
        values, vectors = np.linalg.eigh(np.eye(len(residual)) - hat)
        usable = values > _OWN
        along = vectors[:, usable].T @ residual
        ratios[number] = np.sqrt(np.sum(along**2 / values[usable]) / max(int(usable.sum()), 1))
        prediction = (vectors[:, usable] @ (along / values[usable]))[np.concatenate(of_group)]
        off[number] = factors[group] * np.sqrt(np.mean(prediction**2))
    return LeftOut(ratios, off)

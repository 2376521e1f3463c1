"""Views of LEDs left out in turn, without a new adjustment: how each view moves the LEDs, and how well the others
predict it.

With H the part of the hat matrix that belongs to a view, its residuals would be (I - H)^-1 r if it had been left
out (as in `cross_validation`), and the LEDs would move by -C J^T (I - H)^-1 r. The sum of the squares of these
moves is a covariance of the LEDs that takes only the views for independent, and nothing of noise as stated or of
the model's form (the jackknife by clusters, CR3: Bell and McCaffrey, Survey Methodology 28(2), 2002). A view's six
pose parameters are determined by the view alone; their directions do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from coupole.calibration.leds.equations import (
    ORIENTATION,
    POSITION,
    SPOTS,
    LedState,
    Problem,
    pose_errors,
    whitened_residuals,
)
from coupole.calibration.leds.normal_equations import (
    BoardPart,
    centres_by_own,
    cholesky_factor,
    reduced_normal,
    solve,
)
from coupole.calibration.rotations import Floats

_OWN = 1e-6
"""Directions of a view's residuals with less than this redundancy are determined by the view alone."""


@dataclass(frozen=True)
class LeftOutViews:
    """Predictions of the views by each other, and the LEDs' covariance that follows."""

    ratios: Floats
    """[v] root mean square of the prediction error of each view divided by its standard uncertainty; about 1."""
    centre_covariance: Floats
    """[n, 3, 3] of the LEDs' centres by the jackknife over views, mm^2."""


@dataclass(frozen=True)
class _InView:
    """One board's spots of one view."""

    board: int
    own_gain: Floats
    """[m, 2 k] own^-1 J^T."""
    own_hat: Floats
    """[2 k, 2 k] their part of the hat matrix by the board's own parameters."""
    by_shared: Floats
    """[2 k, shared] derivatives by the shared parameters, the board's own eliminated."""
    residuals: Floats
    """[2 k]."""


def views_left_out(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_]
) -> LeftOutViews:
    """Leave out each view at the solution with these noises [groups]; `accepted_mask` [k] are the spots used."""
    parts, solutions, matrix, _ = reduced_normal(problem, state, factors, accepted_mask.astype(np.float64))
    shared_covariance = np.asarray(cho_solve(cholesky_factor(matrix), np.eye(len(matrix))))
    residuals = whitened_residuals(problem, state) / factors[SPOTS]
    gains = [solution[:, :-1] for solution in solutions]
    by_own = [centres_by_own(problem, state, board).reshape(-1, len(gain)) for board, gain in enumerate(gains)]
    by_shared = [by @ gain for by, gain in zip(by_own, gains, strict=True)]
    count = len(problem.reported_poses)
    ratios, squares = np.zeros(count), np.zeros((len(problem.boards.places_mm), 3, 3))
    for view in range(count):
        in_view = list(_in_view(problem, parts, gains, residuals, accepted_mask, view))
        derivatives, values = _pose_rows(problem, state, factors, view)
        whole = np.concatenate([derivatives, *(board_view.by_shared for board_view in in_view)])
        gain = shared_covariance @ whole.T
        hat, at = whole @ gain, len(values)
        for board_view in in_view:
            rows = slice(at, at + len(board_view.residuals))
            hat[rows, rows] += board_view.own_hat
            at = rows.stop
        ratios[view], left_residuals = _left_residuals(
            hat, np.concatenate([values, *(board_view.residuals for board_view in in_view)])
        )
        shared_move = gain @ left_residuals
        moves_mm = _moves(problem, parts, by_shared, by_own, in_view, shared_move, left_residuals[len(values) :])
        squares += moves_mm[:, :, None] * moves_mm[:, None, :]
    return LeftOutViews(ratios, squares * (count - 1) / count)


def _in_view(
    problem: Problem,
    parts: Sequence[BoardPart],
    gains: Sequence[Floats],
    residuals: Floats,
    accepted_mask: NDArray[np.bool_],
    view: int,
) -> list[_InView]:
    boards_in_view = []
    for board, (part, gain, spots) in enumerate(zip(parts, gains, problem.sightings_of, strict=True)):
        rows_in_view = np.flatnonzero((problem.view[spots] == view) & accepted_mask[spots])
        if not len(rows_in_view):
            continue
        jacobian = part.jacobian[(2 * rows_in_view[:, None] + np.arange(2)).ravel()]
        of_own = jacobian[:, : len(gain)]
        by_shared = np.zeros((len(jacobian), problem.shared_count))
        by_shared[:, part.columns] = jacobian[:, len(gain) :] - of_own @ gain
        own_gain = solve(part.own_normal, of_own.T)
        boards_in_view.append(
            _InView(board, own_gain, of_own @ own_gain, by_shared, residuals[spots[rows_in_view]].ravel())
        )
    return boards_in_view


def _pose_rows(problem: Problem, state: LedState, factors: Floats, view: int) -> tuple[Floats, Floats]:
    """Derivatives [6, shared] and residuals [6] of the view's reported pose."""
    sigmas = problem.sigmas * np.repeat(factors[[POSITION, ORIENTATION]], 3)
    derivatives = np.zeros((6, problem.shared_count))
    derivatives[:, 6 * view : 6 * view + 6] = np.diag(1.0 / sigmas)
    axes = problem.by_axes[view]
    if axes.shape[1]:
        derivatives[:, -axes.shape[1] :] = -axes / sigmas[:, None]
    return derivatives, -pose_errors(problem, state)[view] / sigmas


def _left_residuals(hat: Floats, residuals: Floats) -> tuple[float, Floats]:
    """Ratio of the prediction error to its uncertainty, and the residuals if the view had been left out."""
    values, vectors = np.linalg.eigh(np.eye(len(hat)) - 0.5 * (hat + hat.T))
    usable = values > _OWN
    along = vectors[:, usable].T @ residuals
    ratio = float(np.sqrt(np.sum(along**2 / values[usable]) / max(int(usable.sum()), 1)))
    return ratio, np.asarray(vectors[:, usable] @ (along / values[usable]))


def _moves(
    problem: Problem,
    parts: Sequence[BoardPart],
    by_shared: Sequence[Floats],
    by_own: Sequence[Floats],
    in_view: Sequence[_InView],
    shared_move: Floats,
    left_residuals: Floats,
) -> Floats:
    """[n, 3] mm by which a view moves the centres, against a fit without it."""
    moves_mm = np.zeros((len(problem.boards.places_mm), 3))
    for board, part in enumerate(parts):
        moves_mm[problem.boards.rows_of(board)] = -(by_shared[board] @ shared_move[part.columns]).reshape(-1, 3)
    at = 0
    for board_view in in_view:
        own_step = board_view.own_gain @ left_residuals[at : at + len(board_view.residuals)]
        moves_mm[problem.boards.rows_of(board_view.board)] += (by_own[board_view.board] @ own_step).reshape(-1, 3)
        at += len(board_view.residuals)
    return moves_mm

"""Views of LEDs that are left out in turn, without a new adjustment: how far each view moves the LEDs, and how
well the other views predict it.

With H the part of the hat matrix that belongs to a view, its residuals would be (I - H)^-1 r if it had been left
out (as in `cross_validation`), and the LEDs would move by -C J^T (I - H)^-1 r. The sum of the squares of these
moves is a covariance of the LEDs. It assumes only that the views are independent; it uses neither the stated noise
nor the model's form (the jackknife by clusters, CR3: Bell and McCaffrey, Survey Methodology 28(2), 2002). A view's
six pose parameters are determined by the view alone; their directions do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.leds.equations import (
    ORIENTATION,
    POSITION,
    SPOTS,
    LedState,
    Problem,
    pose_errors,
    whitened_residuals,
)
from coupole.calibration.leds.normal_equations import Reduced, centres_by_own, solve
from coupole.calibration.rotations import Floats

_OWN = 1e-6
"""Directions of a view's residuals with less than this redundancy are determined by the view alone."""


@dataclass(frozen=True)
class LeftOutViews:
    """Predictions of the views by each other, and the LEDs' covariance that follows."""

    ratios: Floats
    """[v] root mean square of the prediction error of each view divided by its standard uncertainty; about 1."""
    centre_covariance: Floats
    """[n, 3, 3] covariance of the LEDs' centres, by the jackknife over views, mm^2."""


@dataclass(frozen=True)
class _InView:
    """One board's spots of one view."""

    board: int
    own_gain: Floats
    """[m, 2 k] own^-1 J^T."""
    own_hat: Floats
    """[2 k, 2 k] part of the hat matrix that comes from the board's own parameters."""
    by_shared: Floats
    """[2 k, shared] derivatives with respect to the shared parameters, after the board's own parameters are
    eliminated."""
    residuals: Floats
    """[2 k]."""


def views_left_out(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], equations: Reduced
) -> LeftOutViews:
    """Leave out the views, one after the other, at the solution with these noises [groups] and normal equations.
    `accepted_mask` [k] is True for the spots that are used."""
    count = len(problem.reported_poses)
    by_own = [
        centres_by_own(problem, state, board).reshape(-1, len(part.gain))
        for board, part in enumerate(equations.parts)
    ]
    ratios, shared_moves = np.zeros(count), np.zeros((problem.shared_count, count))
    moves_mm = np.zeros((count, len(problem.boards.places_mm), 3))
    for view, boards_in_view in enumerate(_boards_in_views(problem, state, factors, accepted_mask, equations)):
        derivatives, values = _pose_rows(problem, state, factors, view)
        half = equations.half_solve(
            np.concatenate([derivatives, *(of_board.by_shared for of_board in boards_in_view)]).T
        )
        hat, at = half.T @ half, len(values)
        rows_of = []
        for of_board in boards_in_view:
            rows_of.append(slice(at, at + len(of_board.residuals)))
            hat[rows_of[-1], rows_of[-1]] += of_board.own_hat
            at = rows_of[-1].stop
        ratios[view], left_residuals = _left_residuals(
            hat, np.concatenate([values, *(of_board.residuals for of_board in boards_in_view)])
        )
        shared_moves[:, view] = equations.other_half_solve(half @ left_residuals)
        for of_board, rows in zip(boards_in_view, rows_of, strict=True):
            own_move_mm = by_own[of_board.board] @ (of_board.own_gain @ left_residuals[rows])
            moves_mm[view, problem.boards.rows_of(of_board.board)] = own_move_mm.reshape(-1, 3)
    for board, part in enumerate(equations.parts):
        by_shared_mm = by_own[board] @ part.gain @ shared_moves[part.columns]
        moves_mm[:, problem.boards.rows_of(board)] -= by_shared_mm.T.reshape(count, -1, 3)
    squares = np.einsum("vni,vnj->nij", moves_mm, moves_mm)
    return LeftOutViews(ratios, squares * (count - 1) / count)


def _boards_in_views(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], equations: Reduced
) -> list[list[_InView]]:
    """Return [v], the boards with spots in each view."""
    residuals = whitened_residuals(problem, state) / factors[SPOTS]
    boards_in_views: list[list[_InView]] = [[] for _ in problem.reported_poses]
    for board, (part, spots) in enumerate(zip(equations.parts, problem.spots_of, strict=True)):
        count = len(part.own_normal)
        of_own = part.jacobian[:, :count]
        own_gain = solve(part.own_normal, of_own.T)
        by_shared = part.jacobian[:, count:] - of_own @ part.gain
        accepted_rows = np.flatnonzero(accepted_mask[spots.rows])
        views = problem.view[spots.rows[accepted_rows]]
        for view in np.unique(views):
            in_view = accepted_rows[views == view]
            rows = (2 * in_view[:, None] + np.arange(2)).ravel()
            of_shared = np.zeros((len(rows), problem.shared_count))
            of_shared[:, part.columns] = by_shared[rows]
            gain = own_gain[:, rows]
            boards_in_views[view].append(
                _InView(board, gain, of_own[rows] @ gain, of_shared, residuals[spots.rows[in_view]].ravel())
            )
    return boards_in_views


def _pose_rows(problem: Problem, state: LedState, factors: Floats, view: int) -> tuple[Floats, Floats]:
    """Return the derivatives [6, shared] and the residuals [6] of the view's reported pose."""
    sigmas = problem.sigmas * np.repeat(factors[[POSITION, ORIENTATION]], 3)
    derivatives = np.zeros((6, problem.shared_count))
    derivatives[:, 6 * view : 6 * view + 6] = np.diag(1.0 / sigmas)
    axes = problem.by_axes[view]
    if axes.shape[1]:
        derivatives[:, -axes.shape[1] :] = -axes / sigmas[:, None]
    return derivatives, -pose_errors(problem, state)[view] / sigmas


def _left_residuals(hat: Floats, residuals: Floats) -> tuple[float, Floats]:
    """Return the ratio of the prediction error to its uncertainty, and the residuals that the view would have if
    it had been left out."""
    values, vectors = np.linalg.eigh(np.eye(len(hat)) - 0.5 * (hat + hat.T))
    usable = values > _OWN
    along = vectors[:, usable].T @ residuals
    ratio = float(np.sqrt(np.sum(along**2 / values[usable]) / max(int(usable.sum()), 1)))
    return ratio, np.asarray(vectors[:, usable] @ (along / values[usable]))

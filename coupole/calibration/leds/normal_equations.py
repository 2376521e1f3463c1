"""Normal equations of the LEDs' adjustment, from which the boards are eliminated one by one (see `adjustment`)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular
from scipy.linalg.lapack import dpotri

from coupole.calibration.leds.equations import (
    ORIENTATION,
    POSITION,
    SPOTS,
    TOLERANCE,
    LedState,
    Linear,
    Problem,
    camera_step,
    linearisation,
    pose_errors,
    table_sigmas,
)
from coupole.calibration.point_sets import Indices
from coupole.calibration.rotations import Floats, between, skew
from coupole.errors import InputError


@dataclass(frozen=True)
class BoardPart:
    """One board's part of the normal equations: its own parameters (pose, then its LEDs' offsets), and their
    coupling with the shared parameters, which are given by `columns`."""

    own_normal: Floats
    """[m, m]."""
    cross: Floats
    """[m, columns]."""
    side: Floats
    """[m]."""
    jacobian: Floats
    """[2 k, m + columns] weighted derivatives of its spots."""
    columns: Indices
    solution: Floats
    """[m, columns + 1] own_normal^-1 [cross, side]."""

    @property
    def gain(self) -> Floats:
        """[m, columns] step of the board's own parameters for a step of the shared parameters, with the sign
        changed."""
        return self.solution[:, :-1]

    def own_step(self, shared_step: Floats) -> Floats:
        """Return the step [m] of the board's own parameters that belongs to a step of all shared parameters."""
        return np.asarray(self.solution[:, -1] - self.gain @ shared_step[self.columns])


@dataclass(frozen=True)
class Reduced:
    """Normal equations from which the boards are eliminated."""

    parts: list[BoardPart]
    """[b]."""
    matrix: Floats
    """[s, s] normal matrix of the shared parameters."""
    side: Floats
    """[s]."""

    @cached_property
    def _factor(self) -> tuple[Floats, bool]:
        return cholesky_factor(self.matrix)

    @cached_property
    def shared_step(self) -> Floats:
        """[s]."""
        return np.asarray(cho_solve(self._factor, self.side))

    @cached_property
    def shared_covariance(self) -> Floats:
        """[s, s]."""
        inverse, _ = dpotri(self._factor[0], lower=True)  # its lower triangle
        return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)

    def half_solve(self, side: Floats) -> Floats:
        """Return L^-1 side, where L is the lower triangle for which matrix = L L^T; `side` is [s, m]."""
        return np.asarray(solve_triangular(self._factor[0], side, lower=True))

    def other_half_solve(self, side: Floats) -> Floats:
        """Return L^-T side [s]. If `side` is the result of `half_solve`, this completes the solution: matrix^-1
        side."""
        return np.asarray(solve_triangular(self._factor[0], side, lower=True, trans=1))


def _board_parts(
    problem: Problem, state: LedState, linear: Linear, factors: Floats, weights: Floats
) -> Iterator[tuple[BoardPart, Floats]]:
    """Yield the part of each board, and the residuals [2 k] of its spots."""
    off_table = between(state.base_from_board, problem.boards.base_from_board)
    tolerance = problem.stated_noise.tolerance_mm * factors[TOLERANCE]
    of_table = table_sigmas(problem)
    root = np.sqrt(weights)[:, None, None] / factors[SPOTS]
    by_board, by_offset = linear.by_board * root, linear.by_offset * root
    by_view, by_camera = linear.by_view * root, linear.by_camera * root
    weighted_residuals = linear.residuals * root[:, :, 0]
    for board, spots in enumerate(problem.spots_of):
        rows, places = spots.rows, problem.boards.rows_of(board)
        count, at = len(rows), np.arange(len(rows))
        leds = np.zeros((count, 2, len(places), 3))
        leds[at, :, spots.leds] = by_offset[rows]
        views = np.zeros((count, 2, (len(spots.columns) - problem.of_camera) // 6, 6))
        views[at, :, spots.views] = by_view[rows]
        blocks = (by_board[rows], leds, views, by_camera[rows])
        jacobian = np.concatenate(
            [block.reshape(2 * count, math.prod(block.shape[2:])) for block in blocks], axis=1
        )
        own_count = 6 + 3 * len(places)
        residuals = weighted_residuals[rows].ravel()
        normal, side = jacobian[:, :own_count].T @ jacobian, jacobian[:, :own_count].T @ residuals
        prior_weights = np.concatenate([of_table, np.full(own_count - 6, tolerance)]) ** -2
        normal[np.arange(own_count), np.arange(own_count)] += prior_weights
        side += prior_weights * np.concatenate([off_table[board], -state.offsets_mm[places].ravel()])
        own_normal, cross = normal[:, :own_count], normal[:, own_count:]
        solution = solve(own_normal, np.column_stack([cross, side]))
        yield BoardPart(own_normal, cross, side, jacobian, spots.columns, solution), residuals


def reduced_normal(problem: Problem, state: LedState, factors: Floats, weights: Floats) -> Reduced:
    """The normal equations at `state`, with the noise of each group [groups] and the weights of the spots [k]."""
    parts: list[BoardPart] = []
    views, axes = 6 * len(problem.reported_poses), slice(6 * len(problem.reported_poses) + problem.of_camera, None)
    matrix, side = np.zeros((problem.shared_count, problem.shared_count)), np.zeros(problem.shared_count)
    for part, residuals in _board_parts(problem, state, linearisation(problem, state), factors, weights):
        shared_jacobian = part.jacobian[:, len(part.own_normal) :]
        matrix[np.ix_(part.columns, part.columns)] += (
            shared_jacobian.T @ shared_jacobian - part.cross.T @ part.gain
        )
        side[part.columns] += shared_jacobian.T @ residuals - part.cross.T @ part.solution[:, -1]
        parts.append(part)
    pose_weights = (problem.sigmas * np.repeat(factors[[POSITION, ORIENTATION]], 3)) ** -2
    off = pose_weights * pose_errors(problem, state)
    by_axes = pose_weights[:, None] * problem.by_axes
    matrix[np.arange(views), np.arange(views)] += np.tile(pose_weights, len(problem.reported_poses))
    matrix[:views, axes] -= by_axes.reshape(views, -1)
    matrix[axes, :views] -= by_axes.reshape(views, -1).T
    matrix[axes, axes] += np.einsum("vij,vik->jk", problem.by_axes, by_axes)
    side[:views] -= off.ravel()
    side[axes] += np.einsum("vij,vi->j", problem.by_axes, off)
    camera = problem.prior_whiten.T @ problem.prior_whiten
    matrix[views:, views:] += camera
    side[views:] -= camera @ camera_step(problem, state)
    return Reduced(parts, matrix, side)


def centres_by_own(problem: Problem, state: LedState, board: int) -> Floats:
    """[LEDs, 3, m] derivatives of the centres of a board's LEDs, base frame, by its own parameters."""
    places = problem.boards.rows_of(board)
    turn = state.base_from_board[board, :3, :3]
    by = np.zeros((len(places), 3, 6 + 3 * len(places)))
    by[:, :, :3] = np.eye(3)
    by[:, :, 3:6] = -turn @ skew(problem.boards.places_mm[places] + state.offsets_mm[places])
    for led in range(len(places)):
        by[led, :, 6 + 3 * led : 9 + 3 * led] = turn
    return by


def solve(matrix: Floats, side: Floats) -> Floats:
    return np.asarray(np.linalg.solve(matrix, side), dtype=np.float64)


def cholesky_factor(matrix: Floats) -> tuple[Floats, bool]:
    try:
        return cho_factor(matrix, lower=True)  # type: ignore[no-any-return]
    except LinAlgError:
        raise InputError(
            "LEDs: the spots do not determine the camera's poses. Take views that differ, each of several boards"
        ) from None

"""Normal equations of the LEDs' adjustment, its boards eliminated one by one (see `adjustment`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor

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
    """One board's part of the normal equations: its own parameters (pose, then its LEDs' offsets) and their
    coupling with the shared ones in `columns`."""

    own_normal: Floats
    """[m, m]."""
    cross: Floats
    """[m, columns]."""
    side: Floats
    """[m]."""
    jacobian: Floats
    """[2 k, m + columns] of its spots, weighted."""
    columns: Indices


def board_parts(
    problem: Problem, state: LedState, linear: Linear, factors: Floats, weights: Floats
) -> Iterator[tuple[BoardPart, Floats]]:
    """The part of each board, and the residuals [2 k] of its spots."""
    off_table = between(state.base_from_board, problem.boards.base_from_board)
    tolerance = problem.stated_noise.tolerance_mm * factors[TOLERANCE]
    root = np.sqrt(weights)[:, None] / factors[SPOTS]
    for board, (rows, columns) in enumerate(zip(problem.sightings_of, problem.columns_of, strict=True)):
        places = problem.boards.rows_of(board)
        count, own_count = len(rows), 6 + 3 * len(places)
        jacobian = np.zeros((count, 2, own_count + len(columns)))
        jacobian[:, :, :6] = linear.by_board[rows]
        at = np.arange(count)[:, None]
        led = np.searchsorted(places, problem.place[rows])
        view = np.searchsorted(columns[: -problem.of_camera : 6], 6 * problem.view[rows])
        for axis in range(2):
            jacobian[at, axis, 6 + 3 * led[:, None] + np.arange(3)] = linear.by_offset[rows, axis]
            jacobian[at, axis, own_count + 6 * view[:, None] + np.arange(6)] = linear.by_view[rows, axis]
        jacobian[:, :, -problem.of_camera :] = linear.by_camera[rows]
        jacobian *= root[rows][:, :, None]
        flat = jacobian.reshape(2 * count, jacobian.shape[2])
        residuals = (linear.residuals[rows] * root[rows]).ravel()
        normal, side = flat[:, :own_count].T @ flat, flat[:, :own_count].T @ residuals
        prior_weights = np.concatenate([table_sigmas(problem), np.full(own_count - 6, tolerance)]) ** -2
        normal[np.arange(own_count), np.arange(own_count)] += prior_weights
        side += prior_weights * np.concatenate([off_table[board], -state.offsets_mm[places].ravel()])
        yield BoardPart(normal[:, :own_count], normal[:, own_count:], side, flat, columns), residuals


def reduced_normal(
    problem: Problem, state: LedState, factors: Floats, weights: Floats
) -> tuple[list[BoardPart], list[Floats], Floats, Floats]:
    """The boards' parts with G = own^-1 [cross, side] of each; the reduced normal matrix and right-hand side of
    the shared parameters."""
    parts: list[BoardPart] = []
    solutions: list[Floats] = []
    views, axes = 6 * len(problem.reported_poses), slice(6 * len(problem.reported_poses) + problem.of_camera, None)
    matrix, side = np.zeros((problem.shared_count, problem.shared_count)), np.zeros(problem.shared_count)
    for part, residuals in board_parts(problem, state, linearisation(problem, state), factors, weights):
        shared_jacobian = part.jacobian[:, len(part.own_normal) :]
        solution = solve(part.own_normal, np.column_stack([part.cross, part.side]))
        matrix[np.ix_(part.columns, part.columns)] += (
            shared_jacobian.T @ shared_jacobian - part.cross.T @ solution[:, :-1]
        )
        side[part.columns] += shared_jacobian.T @ residuals - part.cross.T @ solution[:, -1]
        parts.append(part)
        solutions.append(solution)
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
    return parts, solutions, matrix, side


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

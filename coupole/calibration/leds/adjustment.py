"""All LEDs in one adjustment, with rigid boards, the arm's error at each view, camera, hand-eye and axis zeros.

    pixel = project((base_from_flange_i . E_i . flange_from_camera)^-1 . base_from_board_b . (q_j + d_j))

with q_j a place on the board by the table, d_j the LED's offset from it, E_i the arm's error at view i. Camera,
hand-eye and the zeros of the arm's axes are observed by their record, with its covariance. (Seed 003, section 4
triangulates each LED by itself.) The arm's error at one view shifts all LEDs seen from it alike, so it can be
estimated from the LEDs.

A board's equations have only its own six parameters, its LEDs' offsets and the parameters that views share. So
boards are eliminated one by one (Schur complement; Triggs et al., Bundle adjustment - a modern synthesis, 2000,
section 6), and the size of the reduced system depends on the number of views alone. Noise is estimated as in
`adjustment`, from residuals and redundancy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from coupole.calibration.adjustment import HUBER, REJECT_SIGMA
from coupole.calibration.leds.boards import Boards
from coupole.calibration.leds.equations import (
    GROUPS,
    ORIENTATION,
    POSITION,
    SPOTS,
    TOLERANCE,
    LedState,
    Linear,
    Problem,
    Stated,
    at_centres,
    camera_step,
    cost_of,
    linearisation,
    pose_errors,
    problem_of,
    stepped_state,
    table_sigmas,
    whitened_residuals,
)
from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.point_sets import Indices
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.rotations import Floats, between, skew
from coupole.errors import InputError

_MOST_STEPS, _MOST_ROUNDS = 40, 25
_SETTLED, _STILL = 1e-2, 1e-6
_LEAST_REDUNDANCY, _LEAST_FACTOR = 3.0, 0.03


@dataclass(frozen=True)
class LedGeometry:
    """Positions of all LEDs."""

    state: LedState
    centres_mm: Floats
    """[n, 3] by place, base frame."""
    centre_covariance: Floats
    """[n, 3, 3], mm^2."""
    normal_covariance: Floats
    """[b, 2, 2], deg^2: of a board's turns about its own x and y."""
    shared_part: Floats
    """[n] share of the centre's variance that comes from poses, hand-eye and lens."""
    noise: Floats
    """[groups] estimated over stated."""
    redundancy: Floats
    """[groups]."""
    residuals_px: Floats
    """[k, 2] observed minus computed."""
    accepted_mask: NDArray[np.bool_]
    """[k] False for spots left out as gross errors."""
    prior_step: Floats
    """[free + 6 + k] change of lens, hand-eye and axes, over the standard uncertainties of their record."""
    steps: int

    @property
    def normals(self) -> Floats:
        """[b, 3] of boards, base frame."""
        return self.state.base_from_board[:, :3, 2]


def adjust_leds(
    sightings: LedSightings,
    place: Indices,
    base_from_flange: Floats,
    boards: Boards,
    start: Floats,
    prior: CameraPrior,
    stated_noise: Stated,
) -> LedGeometry:
    """Adjust boards, LEDs, poses [v, 4, 4] as reported, lens and hand-eye.

    `place` [k] is that of each spot; `start` [b, 4, 4] is the approximate pose of each board. Raises InputError if
    the adjustment does not converge, as with contradicting spots.
    """
    state = LedState(
        start,
        np.zeros_like(boards.places_mm),
        base_from_flange,
        prior.flange_from_camera,
        prior.lens.vector(),
        np.zeros(len(prior.covariance) - len(prior.free) - 6),
    )
    problem = problem_of(sightings, place, boards, base_from_flange, prior, stated_noise)
    factors, keep, step_count = np.ones(len(GROUPS)), np.ones(len(place), np.bool_), 0
    state, step_count = _descend(problem, state, factors, keep, 3.0 * HUBER)
    problem = at_centres(problem, state)
    for robust in (True, False):
        for _ in range(_MOST_ROUNDS):
            state, steps = _descend(problem, state, factors, keep, HUBER if robust else np.inf)
            step_count += steps
            residuals = whitened_residuals(problem, state)
            off = np.sqrt(np.mean(residuals**2, axis=1))
            before, seen_factors = keep, factors.copy()
            if robust:
                seen_factors[SPOTS] = max(1.4826 * float(np.median(np.abs(residuals))), _LEAST_FACTOR)
            else:
                seen_factors = _solution(problem, state, factors, keep).noise_factors
            is_settled = bool(np.all(np.abs(seen_factors / factors - 1) < _SETTLED))
            factors = seen_factors
            keep = off <= REJECT_SIGMA * factors[SPOTS] / np.sqrt(2)
            if is_settled and (robust or bool((keep == before).all())):
                break
    return _summary(problem, state, factors, keep, step_count)


# -- normal equations, board by board ---------------------------------------------------------------------


@dataclass(frozen=True)
class _BoardPart:
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


def _board_parts(
    problem: Problem, state: LedState, linear: Linear, factors: Floats, weights: Floats
) -> Iterator[tuple[_BoardPart, Floats]]:
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
        yield _BoardPart(normal[:, :own_count], normal[:, own_count:], side, flat, columns), residuals


def _normal(
    problem: Problem, state: LedState, factors: Floats, weights: Floats
) -> tuple[list[_BoardPart], list[Floats], Floats, Floats]:
    """The boards' parts with G = own^-1 [cross, side] of each; the reduced normal matrix and right-hand side of
    the shared parameters."""
    parts: list[_BoardPart] = []
    solutions: list[Floats] = []
    views, axes = 6 * len(problem.reported_poses), slice(6 * len(problem.reported_poses) + problem.of_camera, None)
    matrix, side = np.zeros((problem.shared_count, problem.shared_count)), np.zeros(problem.shared_count)
    for part, residuals in _board_parts(problem, state, linearisation(problem, state), factors, weights):
        shared_jacobian = part.jacobian[:, len(part.own_normal) :]
        solution = _solve(part.own_normal, np.column_stack([part.cross, part.side]))
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


def _descend(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], huber: float
) -> tuple[LedState, int]:
    """Gauss-Newton with Huber's weights; a step that does not lower the cost is halved."""
    cost = cost_of(problem, state, factors, accepted_mask, huber)
    for step in range(1, _MOST_STEPS + 1):
        off = np.sqrt(np.sum(whitened_residuals(problem, state) ** 2, axis=1)) / factors[SPOTS]
        weights = np.where(accepted_mask, np.minimum(1.0, huber / np.maximum(off, 1e-12)), 0.0)
        parts, solutions, matrix, side = _normal(problem, state, factors, weights)
        shared_step = cho_solve(_cholesky_factor(matrix), side)
        own_steps = [s[:, -1] - s[:, :-1] @ shared_step[p.columns] for p, s in zip(parts, solutions, strict=True)]
        share, tried_state = 1.0, stepped_state(problem, state, shared_step, own_steps, 1.0)
        while (now := cost_of(problem, tried_state, factors, accepted_mask, huber)) > cost * (
            1 + 1e-12
        ) and share > 1e-3:
            share /= 2
            tried_state = stepped_state(problem, state, shared_step, own_steps, share)
        if now > cost * (1 + 1e-12):
            return state, step
        state, gain, cost = tried_state, cost - now, now
        if gain < _STILL * max(cost, 1.0):
            return state, step
    raise InputError(
        f"LEDs: no convergence in {_MOST_STEPS} steps. Look for views of another camera or dome, and for "
        "records of another lens"
    )


def _solve(matrix: Floats, side: Floats) -> Floats:
    return np.asarray(np.linalg.solve(matrix, side), dtype=np.float64)


def _cholesky_factor(matrix: Floats) -> tuple[Floats, bool]:
    try:
        return cho_factor(matrix, lower=True)  # type: ignore[no-any-return]
    except LinAlgError:
        raise InputError(
            "LEDs: the spots do not determine the camera's poses. Take views that differ, each of several boards"
        ) from None


# -- noise and uncertainty --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Solved:
    """Covariances at the solution, and the noise by the residuals."""

    own_covariances: list[Floats]
    """[b] of each board's own parameters."""
    alone: list[Floats]
    """[b] the same if the shared parameters were known."""
    noise_factors: Floats
    redundancy: Floats


def _solution(problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_]) -> _Solved:
    parts, solutions, matrix, _ = _normal(problem, state, factors, accepted_mask.astype(np.float64))
    shared_covariance = cho_solve(_cholesky_factor(matrix), np.eye(len(matrix)))
    own_covariances: list[Floats] = []
    alone: list[Floats] = []
    used_freedom = np.zeros(len(GROUPS))
    for part, solution in zip(parts, solutions, strict=True):
        count, gain = len(part.own_normal), solution[:, :-1]
        block = shared_covariance[np.ix_(part.columns, part.columns)]
        alone.append(_solve(part.own_normal, np.eye(count)))
        own_covariances.append(alone[-1] + gain @ block @ gain.T)
        whole = np.block([[own_covariances[-1], -gain @ block], [-block @ gain.T, block]])
        used_freedom[SPOTS] += float(np.sum((part.jacobian @ whole) * part.jacobian))
        used_freedom[TOLERANCE] += float(np.trace(own_covariances[-1][6:, 6:]))
        assert count == len(own_covariances[-1])
    variance = _of_pose_errors(problem, shared_covariance)
    used_freedom[TOLERANCE] /= (problem.stated_noise.tolerance_mm * factors[TOLERANCE]) ** 2
    scaled_variance = variance / (problem.sigmas * np.repeat(factors[[POSITION, ORIENTATION]], 3)) ** 2
    used_freedom[POSITION], used_freedom[ORIENTATION] = scaled_variance[:, :3].sum(), scaled_variance[:, 3:].sum()
    off = pose_errors(problem, state) / problem.sigmas
    groups = (
        whitened_residuals(problem, state)[accepted_mask],
        state.offsets_mm / problem.stated_noise.tolerance_mm,
        off[:, :3],
        off[:, 3:],
    )
    redundancy = np.array([part.size for part in groups]) - used_freedom
    chi2 = np.array([float(np.sum(part**2)) for part in groups])
    seen_factors = np.sqrt(chi2 / np.maximum(redundancy, 1e-9))
    has_redundancy = redundancy >= _LEAST_REDUNDANCY
    return _Solved(
        own_covariances,
        alone,
        np.where(has_redundancy, np.maximum(seen_factors, _LEAST_FACTOR), factors),
        redundancy,
    )


def _of_pose_errors(problem: Problem, shared_covariance: Floats) -> Floats:
    """[v, 6] variance of `pose_errors` by the covariance of the shared parameters."""
    views, axes = 6 * len(problem.reported_poses), slice(6 * len(problem.reported_poses) + problem.of_camera, None)
    with_axes = shared_covariance[:views, axes].reshape(*problem.by_axes.shape)
    by = problem.by_axes
    own_variance = np.diag(shared_covariance)[:views].reshape(-1, 6)
    joint: Floats = np.einsum("vij,jk,vik->vi", by, shared_covariance[axes, axes], by) - 2 * np.sum(
        with_axes * by, axis=2
    )
    return own_variance + joint


def _summary(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], steps: int
) -> LedGeometry:
    solution = _solution(problem, state, factors, accepted_mask)
    boards = problem.boards
    centres = np.empty((len(boards.places_mm), 3, 3))
    shared_part = np.empty(len(centres))
    normals = np.empty((len(boards.numbers), 2, 2))
    for board, (own_covariance, alone) in enumerate(zip(solution.own_covariances, solution.alone, strict=True)):
        turn = state.base_from_board[board, :3, :3]
        normals[board] = np.degrees(np.degrees(own_covariance[3:5, 3:5]))
        for led, place in enumerate(boards.rows_of(board)):
            by = np.zeros((3, len(own_covariance)))
            by[:, :3] = np.eye(3)
            by[:, 3:6] = -turn @ skew(boards.places_mm[place] + state.offsets_mm[place])
            by[:, 6 + 3 * led : 9 + 3 * led] = turn
            centres[place] = by @ own_covariance @ by.T
            shared_part[place] = 1 - np.trace(by @ alone @ by.T) / np.trace(centres[place])
    residuals = _solve(problem.whiten, whitened_residuals(problem, state)[:, :, None])[:, :, 0]
    step = camera_step(problem, state) / np.sqrt(np.diag(problem.prior.covariance))
    return LedGeometry(
        state,
        boards.in_base(state.base_from_board, state.offsets_mm),
        centres,
        normals,
        shared_part,
        factors,
        solution.redundancy,
        residuals,
        accepted_mask,
        step,
        steps,
    )

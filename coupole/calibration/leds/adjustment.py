"""All LEDs in one adjustment, with rigid boards, the arm's error at each view, camera, hand-eye and axis zeros.

    pixel = project((base_from_flange_i . E_i . flange_from_camera)^-1 . base_from_board_b . (q_j + d_j))

with q_j a place on the board by the table, d_j the LED's offset from it, E_i the arm's error at view i. Camera,
hand-eye and the zeros of the arm's axes are observed by their record, with its covariance. (Lucat et al. 2025,
section 4 triangulates each LED by itself.) The arm's error at one view shifts all LEDs that this view sees in the
same way, so it can be estimated from the LEDs. Suspects (`suspects`) shift spots; their coefficients are shared
unknowns with a prior.

A board's equations have only its own six parameters, its LEDs' offsets and the parameters that views share. So
boards are eliminated one by one (Schur complement; Triggs et al., Bundle adjustment - a modern synthesis, 2000,
section 6), and the size of the reduced system depends on the number of views alone. Noise is estimated as in
`adjustment`, from residuals and redundancy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.adjustment import HUBER, REJECT_SIGMA
from coupole.calibration.leds.equations import (
    GROUPS,
    ORIENTATION,
    POSITION,
    SPOTS,
    TOLERANCE,
    LedState,
    Problem,
    at_centres,
    camera_step,
    cost_of,
    pose_errors,
    stepped_state,
    table_sigmas,
    whitened_residuals,
    with_modes,
)
from coupole.calibration.leds.left_out import LeftOutViews, views_left_out
from coupole.calibration.leds.normal_equations import Reduced, centres_by_own, reduced_normal, solve
from coupole.calibration.leds.suspects import FIELD, SuspectedShift, as_found, judge, step_of_records
from coupole.calibration.point_sets import Indices
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_MOST_STEPS, _MOST_ROUNDS = 40, 25
_SETTLED, _STILL = 1e-2, 1e-6
_LEAST_REDUNDANCY, _LEAST_FACTOR = 3.0, 0.03


@dataclass(frozen=True)
class LedGeometry:
    """Positions of all LEDs."""

    state: LedState
    centres_mm: Floats
    """[n, 3] centres of the LEDs, by place on the boards; base frame."""
    centre_covariance: Floats
    """[n, 3, 3], mm^2."""
    normal_covariance: Floats
    """[b, 2, 2] covariance of a board's turns about its own x and y, deg^2."""
    shared_part: Floats
    """[n] share of the centre's variance that comes from poses, hand-eye and lens."""
    degrees: Floats
    """[n] effective degrees of freedom of the centre's uncertainty."""
    noise: Floats
    """[groups] estimated over stated."""
    redundancy: Floats
    """[groups]."""
    residuals_px: Floats
    """[k, 2] observed minus computed."""
    accepted_mask: NDArray[np.bool_]
    """[k] False for spots that were left out as gross errors."""
    prior_step: Floats
    """[free + 6 + k] changes of lens, hand-eye and axes, divided by the standard uncertainties of their record. If
    the growth of the picture is a named suspect, its change is included."""
    steps: int
    suspects: tuple[SuspectedShift, ...]
    views: LeftOutViews

    @property
    def normals(self) -> Floats:
        """[b, 3] normals of the boards, base frame."""
        return self.state.base_from_board[:, :3, 2]

    def left_out_ratio(self, places: Indices) -> float:
        """Uncertainty of the centres that follows from leaving views out, divided by the stated uncertainty:
        median over these places."""
        by_views, stated_variance = (
            np.trace(covariance[places], axis1=1, axis2=2)
            for covariance in (self.views.centre_covariance, self.centre_covariance)
        )
        return float(np.sqrt(np.median(by_views / stated_variance)))


def adjust_leds(problem: Problem, start: Floats) -> LedGeometry:
    """Adjust boards, LEDs, poses, lens and hand-eye, and judge the suspects.

    `problem` is made by `problem_of`; `start` [b, 4, 4] is the approximate pose of each board. Raises InputError
    if the adjustment does not converge, as with contradicting spots.
    """
    prior, modes = problem.prior, problem.modes
    state = LedState(
        start,
        np.zeros_like(problem.boards.places_mm),
        problem.reported_poses,
        prior.flange_from_camera,
        prior.lens.vector(),
        np.zeros(len(prior.covariance) - len(prior.free) - 6),
        np.zeros(len(modes)),
    )
    factors, keep = np.ones(len(GROUPS)), np.ones(len(problem.place), np.bool_)
    state = _descend(problem, state, factors, keep, 3.0 * HUBER).state
    problem = at_centres(problem, state)
    fit = _settled_fit(problem, _Fit(state, factors, keep, 0), is_robust=True)
    fit = _settled_fit(problem, fit, is_robust=False)
    suspects: tuple[SuspectedShift, ...] = ()
    if modes:
        equations = _reduced_at(problem, fit)
        solution = _solution(problem, fit.state, fit.factors, fit.accepted_mask, equations)
        degrees = float(solution.redundancy[[POSITION, ORIENTATION]].sum())
        suspects = judge(modes, fit.state.coefficients, solution.coefficient_covariance, degrees)
        problem = with_modes(problem, as_found(modes, suspects))
        fit = _settled_fit(problem, fit, is_robust=False)
    return _summary(problem, fit, suspects)


@dataclass(frozen=True)
class _Fit:
    """Values, noises and accepted spots at one stage of the adjustment."""

    state: LedState
    factors: Floats
    accepted_mask: NDArray[np.bool_]
    steps: int


def _settled_fit(problem: Problem, fit: _Fit, *, is_robust: bool) -> _Fit:
    """Adjust until noises and accepted spots no longer change."""
    state, factors, keep, step_count = fit.state, fit.factors, fit.accepted_mask, fit.steps
    for _ in range(_MOST_ROUNDS):
        descent = _descend(problem, state, factors, keep, HUBER if is_robust else np.inf)
        state, step_count = descent.state, step_count + descent.steps
        residuals = whitened_residuals(problem, state)
        off = np.sqrt(np.mean(residuals**2, axis=1))
        before, seen_factors = keep, factors.copy()
        if is_robust:
            seen_factors[SPOTS] = max(1.4826 * float(np.median(np.abs(residuals))), _LEAST_FACTOR)
        else:
            seen_factors = _solution(problem, state, factors, keep, descent.last_equations).noise_factors
        is_settled = bool(np.all(np.abs(seen_factors / factors - 1) < _SETTLED))
        factors = seen_factors
        keep = off <= REJECT_SIGMA * factors[SPOTS] / np.sqrt(2)
        if is_settled and (is_robust or bool((keep == before).all())):
            break
    return _Fit(state, factors, keep, step_count)


@dataclass(frozen=True)
class _Descent:
    """State and equations at the end of a descent."""

    state: LedState
    steps: int
    last_equations: Reduced
    """Normal equations of the last step, which changed the cost by less than the share `_STILL`."""


def _descend(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], huber: float
) -> _Descent:
    """Gauss-Newton with Huber's weights; a step that does not lower the cost is halved."""
    cost = cost_of(problem, state, factors, accepted_mask, huber)
    for step in range(1, _MOST_STEPS + 1):
        off = np.sqrt(np.sum(whitened_residuals(problem, state) ** 2, axis=1)) / factors[SPOTS]
        weights = np.where(accepted_mask, np.minimum(1.0, huber / np.maximum(off, 1e-12)), 0.0)
        equations = reduced_normal(problem, state, factors, weights)
        shared_step = equations.shared_step
        own_steps = [part.own_step(shared_step) for part in equations.parts]
        share, tried_state = 1.0, stepped_state(problem, state, shared_step, own_steps, 1.0)
        while (now := cost_of(problem, tried_state, factors, accepted_mask, huber)) > cost * (
            1 + 1e-12
        ) and share > 1e-3:
            share /= 2
            tried_state = stepped_state(problem, state, shared_step, own_steps, share)
        if now > cost * (1 + 1e-12):
            return _Descent(state, step, equations)
        state, gain, cost = tried_state, cost - now, now
        if gain < _STILL * max(cost, 1.0):
            return _Descent(state, step, equations)
    raise InputError(
        f"LEDs: no convergence in {_MOST_STEPS} steps. Look for views of another camera or dome, and for "
        "records of another lens"
    )


# -- noise and uncertainty --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Solved:
    """Covariances at the solution, and the noise as estimated from the residuals."""

    own_covariances: list[Floats]
    """[b] covariances of each board's own parameters."""
    alone: list[Floats]
    """[b] the same covariances, if the shared parameters were known exactly."""
    noise_factors: Floats
    redundancy: Floats
    coefficient_covariance: Floats
    """[c, c] covariance of the suspects' modes."""


def _reduced_at(problem: Problem, fit: _Fit) -> Reduced:
    """Return the normal equations at the solution of a fit, with equal weights for its spots."""
    return reduced_normal(problem, fit.state, fit.factors, fit.accepted_mask.astype(np.float64))


def _solution(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], equations: Reduced
) -> _Solved:
    """Return the covariances from `equations`, and the noise from the residuals of the accepted spots [k] at
    `state`.

    The degrees of freedom that the spots use are not summed over the spots: the traces of the spots' and the
    priors' parts add up to the number of parameters, and the traces of the priors need only the diagonal blocks.
    """
    shared_covariance = equations.shared_covariance
    own_covariances: list[Floats] = []
    alone: list[Floats] = []
    of_table = table_sigmas(problem) ** -2
    used_freedom, by_priors, parameters = np.zeros(len(GROUPS)), 0.0, len(shared_covariance)
    for part in equations.parts:
        block = shared_covariance[np.ix_(part.columns, part.columns)]
        alone.append(solve(part.own_normal, np.eye(len(part.own_normal))))
        own_covariances.append(alone[-1] + part.gain @ block @ part.gain.T)
        own_variance = np.diag(own_covariances[-1])
        parameters += len(own_variance)
        by_priors += float(of_table @ own_variance[:6])
        used_freedom[TOLERANCE] += float(own_variance[6:].sum())
    used_freedom[TOLERANCE] /= (problem.stated_noise.tolerance_mm * factors[TOLERANCE]) ** 2
    variance = _of_pose_errors(problem, shared_covariance)
    scaled_variance = variance / (problem.sigmas * np.repeat(factors[[POSITION, ORIENTATION]], 3)) ** 2
    used_freedom[POSITION], used_freedom[ORIENTATION] = scaled_variance[:, :3].sum(), scaled_variance[:, 3:].sum()
    of_camera = (
        problem.prior_whiten @ shared_covariance[-len(problem.prior_whiten) :, -len(problem.prior_whiten) :]
    )
    by_priors += float(np.sum(of_camera * problem.prior_whiten))
    used_freedom[SPOTS] = parameters - by_priors - used_freedom[[TOLERANCE, POSITION, ORIENTATION]].sum()
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
        shared_covariance[problem.columns_of_modes, problem.columns_of_modes],
    )


def _of_pose_errors(problem: Problem, shared_covariance: Floats) -> Floats:
    """Return [v, 6], the variance of `pose_errors` that follows from the covariance of the shared parameters."""
    views, axes = 6 * len(problem.reported_poses), slice(6 * len(problem.reported_poses) + problem.of_camera, None)
    with_axes = shared_covariance[:views, axes].reshape(*problem.by_axes.shape)
    by = problem.by_axes
    own_variance = np.diag(shared_covariance)[:views].reshape(-1, 6)
    joint: Floats = np.einsum("vij,jk,vik->vi", by, shared_covariance[axes, axes], by) - 2 * np.sum(
        with_axes * by, axis=2
    )
    return own_variance + joint


def _summary(problem: Problem, fit: _Fit, suspects: tuple[SuspectedShift, ...]) -> LedGeometry:
    state, factors = fit.state, fit.factors
    equations = _reduced_at(problem, fit)
    solution = _solution(problem, state, factors, fit.accepted_mask, equations)
    boards = problem.boards
    centres = np.empty((len(boards.places_mm), 3, 3))
    shared_part = np.empty(len(centres))
    normals = np.empty((len(boards.numbers), 2, 2))
    for board, (own_covariance, alone) in enumerate(zip(solution.own_covariances, solution.alone, strict=True)):
        normals[board] = np.degrees(np.degrees(own_covariance[3:5, 3:5]))
        for place, by in zip(boards.rows_of(board), centres_by_own(problem, state, board), strict=True):
            centres[place] = by @ own_covariance @ by.T
            shared_part[place] = 1 - np.trace(by @ alone @ by.T) / np.trace(centres[place])
    residuals = solve(problem.whiten, whitened_residuals(problem, state)[:, :, None])[:, :, 0]
    first_mode = len(problem.prior.free) + 6
    step = np.delete(camera_step(problem, state), first_mode + np.arange(len(problem.modes)))
    if any(suspect.name == FIELD and suspect.is_named for suspect in suspects):
        turn = state.flange_from_camera[:3, :3]
        step[:first_mode] += step_of_records(
            problem.modes, state.coefficients, state.lens, problem.prior.free, turn
        )
    return LedGeometry(
        state,
        boards.in_base(state.base_from_board, state.offsets_mm),
        centres,
        normals,
        shared_part,
        _degrees(shared_part, solution.redundancy),
        factors,
        solution.redundancy,
        residuals,
        fit.accepted_mask,
        step / np.sqrt(np.diag(problem.prior.covariance)),
        fit.steps,
        suspects,
        views_left_out(problem, state, factors, fit.accepted_mask, equations),
    )


def _degrees(shared_part: Floats, redundancy: Floats) -> Floats:
    """[n] effective degrees of freedom of each centre's uncertainty (Welch-Satterthwaite). Half of the part that
    centres share is assumed to come from the poses' positions, half from their orientations."""
    position, orientation, spots = np.maximum(redundancy[[POSITION, ORIENTATION, SPOTS]], 1.0)
    of_poses = shared_part**2 / 4 * (1 / position + 1 / orientation)
    return np.asarray(1.0 / (of_poses + (1.0 - shared_part) ** 2 / spots))

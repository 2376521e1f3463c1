"""Least squares with variance components: values, covariance, and the dominant sources of uncertainty.

Observations come in blocks. A block has residuals divided by their stated noise, and derivatives by the few
parameters that it depends on. It belongs to one group (corners, robot's positions, robot's orientations, ...). The
normal matrix is summed block by block, so the full Jacobian is never built. After convergence the noise of each
group is estimated from its residuals and its redundancy (Foerstner, Photogrammetric Engineering 1979; the iterated
estimate is REML). The adjustment is repeated until the estimates no longer change.

Two more results follow from the normal matrix. One is the contribution of each group to each parameter's variance
(from C = C N C, where N is the sum over the groups). The other is the effective degrees of freedom of each
standard uncertainty (Welch-Satterthwaite, GUM annex G.4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import stdtrit

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

S = TypeVar("S")

HUBER = 2.0
REJECT_SIGMA = 5.0
"""Greatest norm of an image point's residual: with normal noise, one point in 270,000 exceeds it."""
_MAX_STEPS = 60
_MAX_ROUNDS = 30
_SETTLED = 1e-3
"""Noise factors have converged when their relative change is below this."""
_SINGULAR = 1e-6
"""Least diagonal element of the Cholesky factor of the scaled normal matrix. Its square is the share of a
parameter's information that is left if the earlier parameters are unknown too."""
_LEAST_REDUNDANCY = 3.0
"""Least redundancy with which the residuals determine the noise."""
_LEAST_FACTOR = 1e-4
"""Lower bound of a noise factor (estimated over stated noise). Without it, residuals of nearly zero would give a
group unlimited weight."""


@dataclass(frozen=True)
class Group:
    """Observations that share one noise."""

    name: str
    is_estimated: bool
    """True if the noise is estimated from residuals. If it is False, or if there are too few observations, the
    stated noise is used."""
    rejects: int = 0
    """Number of residuals of one observation (2 for an image point) if single observations may be rejected;
    otherwise 0."""


@dataclass(frozen=True)
class Block:
    """Some observations: residuals [m] (observed minus computed, divided by the stated noise), derivatives of the
    computed values [m, k], columns of the k parameters, and the group's number."""

    residuals: Floats
    jacobian: Floats
    columns: np.ndarray[tuple[int], np.dtype[np.intp]]
    group: int


@dataclass(frozen=True)
class _Problem(Generic[S]):
    """The problem: blocks of a state, the state after a step [parameters], and the groups of observations."""

    evaluate: Callable[[S], list[Block]]
    move: Callable[[S, Floats], S]
    groups: Sequence[Group]
    parameters: int
    calibration_name: str
    """Name of the calibration in errors."""


@dataclass(frozen=True)
class Component:
    """Estimate of one group's noise from its residuals."""

    name: str
    factor: float
    """Estimated noise, divided by the stated noise; 1 if the noise was not to be estimated."""
    rejected_count: int
    redundancy: float
    chi2: float
    """Sum of the squares of the residuals, each divided by the stated noise."""


@dataclass(frozen=True)
class Adjusted(Generic[S]):
    """The result: state, covariance [p, p] of a step of its parameters, and the estimated noise."""

    state: S
    covariance: Floats
    components: tuple[Component, ...]
    contributions: Floats
    """Share [groups, p] of each parameter's variance that comes from each group of observations."""
    degrees: Floats
    """Effective degrees of freedom [p]."""
    residuals: tuple[Floats, ...]
    """Residuals of each block, divided by the stated noise."""
    accepted_masks: tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], ...]
    """Masks of each block: True for residuals that were not rejected."""
    steps: int

    def factor(self, name: str) -> float:
        return next(component.factor for component in self.components if component.name == name)


def coverage_factor(degrees: Floats | float, coverage: float = 0.95) -> Floats:
    """Return k for a two-sided interval, from Student's distribution."""
    return np.asarray(stdtrit(np.maximum(degrees, 1.0), 0.5 + coverage / 2))


def adjust(
    state: S,
    evaluate: Callable[[S], list[Block]],
    move: Callable[[S, Floats], S],
    groups: Sequence[Group],
    parameters: int,
    *,
    calibration_name: str,
) -> Adjusted[S]:
    """Minimise the sum of squared residuals (Levenberg-Marquardt), estimate the noise, reject gross errors.

    First, Huber's weights limit the influence of gross errors. Then residuals beyond `REJECT_SIGMA` are left out,
    and the others are weighted by their noise alone. `calibration_name` names the calibration in errors. Raises
    InputError if the observations do not determine all parameters.
    """
    problem = _Problem(evaluate, move, groups, parameters, calibration_name)
    factors = np.ones(len(groups))
    blocks = evaluate(state)
    masks = [np.ones(len(block.residuals), dtype=np.bool_) for block in blocks]
    weights = [k.astype(np.float64) for k in masks]
    rejecting = any(group.rejects for group in groups)
    step_count = 0
    for robust in (True, False) if rejecting else (False,):
        for _ in range(_MAX_ROUNDS):
            if robust:
                weights = [_huber(b, groups[b.group].rejects, factors[b.group]) for b in blocks]
            state, blocks, steps = _descend(problem, state, blocks, weights, factors)
            step_count += steps
            if robust:
                new_factors = _robust_factors(blocks, groups, factors)
            else:
                new_factors = _seen_factors(problem, blocks, masks, weights, factors)
            is_settled = bool(np.all(np.abs(new_factors / factors - 1) < _SETTLED))
            factors = new_factors
            if not robust and (new_masks := _reject(blocks, groups, masks, factors)):
                masks, is_settled = new_masks, False
                weights = [k.astype(np.float64) for k in masks]
            if is_settled:
                break
        if robust:
            masks = _reject(blocks, groups, masks, factors) or masks
            weights = [k.astype(np.float64) for k in masks]
    return _summary(problem, state, blocks, masks, weights, factors, step_count)


def _normals(
    blocks: Sequence[Block], weights: Sequence[Floats], groups: int, parameters: int
) -> tuple[Floats, Floats]:
    """Return the normal matrices [groups, p, p] and right-hand sides [groups, p], with the stated noise."""
    matrices, sides = np.zeros((groups, parameters, parameters)), np.zeros((groups, parameters))
    for block, weight in zip(blocks, weights, strict=True):
        weighted_jacobian = block.jacobian * weight[:, None]
        matrices[block.group][np.ix_(block.columns, block.columns)] += weighted_jacobian.T @ block.jacobian
        sides[block.group][block.columns] += weighted_jacobian.T @ block.residuals
    return matrices, sides


def _cost(blocks: Sequence[Block], weights: Sequence[Floats], factors: Floats) -> float:
    return sum(
        float(weight @ block.residuals**2) / float(factors[block.group]) ** 2
        for block, weight in zip(blocks, weights, strict=True)
    )


def _descend(
    problem: _Problem[S], state: S, blocks: list[Block], weights: Sequence[Floats], factors: Floats
) -> tuple[S, list[Block], int]:
    """Run Levenberg-Marquardt with fixed weights, until a step no longer lowers the cost."""
    damping, cost = 1e-6, _cost(blocks, weights, factors)
    for step in range(1, _MAX_STEPS + 1):
        matrices, sides = _normals(blocks, weights, len(factors), problem.parameters)
        normal = np.einsum("g,gij->ij", factors**-2.0, matrices)
        side = factors**-2.0 @ sides
        while True:
            damped_normal = normal + damping * np.diag(np.diag(normal))
            change = cho_solve(_cholesky_factor(damped_normal, problem.calibration_name), side)
            tried_state = problem.move(state, change)
            tried_blocks = problem.evaluate(tried_state)
            tried_cost = _cost(tried_blocks, weights, factors)
            if tried_cost <= cost or damping > 1e8:
                break
            damping *= 10
        if not tried_cost <= cost:
            return state, blocks, step
        gain, predicted_gain = cost - tried_cost, float(change @ side)
        state, blocks, cost, damping = tried_state, tried_blocks, tried_cost, max(damping / 10, 1e-12)
        if predicted_gain < 1e-7 or gain < 1e-12 * cost:  # a step of 3e-4 of the uncertainty
            return state, blocks, step
    raise InputError(
        f"{problem.calibration_name}: no convergence in {_MAX_STEPS} steps. Look for views of another board or "
        "camera, and take views that differ more in tilt, roll and distance."
    )


def _cholesky_factor(normal: Floats, calibration_name: str) -> tuple[Floats, bool]:
    """Return the Cholesky factor of the normal matrix, which is scaled to a unit diagonal for the test of its
    rank."""
    diagonal = np.diag(normal)
    if (diagonal > 0).all():
        scale = diagonal**-0.5
        try:
            factor, lower = cho_factor(normal * np.outer(scale, scale), lower=True)
        except LinAlgError:
            pass
        else:
            if np.diag(factor).min() > _SINGULAR:
                return np.asarray(factor / scale[:, None]), lower
    raise InputError(
        f"{calibration_name}: the observations do not determine all parameters. Take views that differ more in "
        f"tilt, roll and "
        "distance, or leave fewer parameters free."
    )


def _observations(values: Floats, size: int) -> Floats:
    """Return the root mean square of the residuals of each observation, which has `size` residuals."""
    return np.asarray(np.sqrt(np.mean(values.reshape(-1, size) ** 2, axis=1)))


def _huber(block: Block, size: int, factor: float) -> Floats:
    if not size:
        return np.ones(len(block.residuals))
    far = _observations(block.residuals, size) / factor
    return np.asarray(np.repeat(np.minimum(1.0, HUBER / np.maximum(far, 1e-12)), size))


def _robust_factors(blocks: Sequence[Block], groups: Sequence[Group], factors: Floats) -> Floats:
    """Return the noise from the median of absolute residuals for groups that may have gross errors. The noise of
    the other groups is unchanged."""
    new_factors = factors.copy()
    for number, group in enumerate(groups):
        if group.rejects and group.is_estimated:
            residuals = np.concatenate([b.residuals for b in blocks if b.group == number])
            new_factors[number] = max(1.4826 * float(np.median(np.abs(residuals))), _LEAST_FACTOR)
    return new_factors


def _seen_factors(
    problem: _Problem[S],
    blocks: Sequence[Block],
    accepted_masks: Sequence[np.ndarray[tuple[int], np.dtype[np.bool_]]],
    weights: Sequence[Floats],
    factors: Floats,
) -> Floats:
    """Return the noise of each group from its squared residuals divided by its redundancy."""
    matrices, _ = _normals(blocks, weights, len(problem.groups), problem.parameters)
    covariance = _covariance(matrices, factors, problem.calibration_name)
    new_factors = factors.copy()
    for number, group in enumerate(problem.groups):
        if not group.is_estimated:
            continue
        chi2, count = _chi2(blocks, accepted_masks, number)
        redundancy = count - float(np.sum(covariance * matrices[number])) / factors[number] ** 2
        if redundancy >= _LEAST_REDUNDANCY:
            new_factors[number] = max(np.sqrt(chi2 / redundancy), _LEAST_FACTOR)
    return new_factors


def _covariance(matrices: Floats, factors: Floats, calibration_name: str) -> Floats:
    normal = np.einsum("g,gij->ij", factors**-2.0, matrices)
    return np.asarray(cho_solve(_cholesky_factor(normal, calibration_name), np.eye(len(normal))))


def _chi2(
    blocks: Sequence[Block], accepted_masks: Sequence[np.ndarray[tuple[int], np.dtype[np.bool_]]], group: int
) -> tuple[float, int]:
    pairs = [
        (b.residuals[k], int(k.sum())) for b, k in zip(blocks, accepted_masks, strict=True) if b.group == group
    ]
    return sum(float(r @ r) for r, _ in pairs), sum(count for _, count in pairs)


def _reject(
    blocks: Sequence[Block],
    groups: Sequence[Group],
    accepted_masks: Sequence[np.ndarray[tuple[int], np.dtype[np.bool_]]],
    factors: Floats,
) -> list[np.ndarray[tuple[int], np.dtype[np.bool_]]] | None:
    """Return masks of the residuals of each block that are within `REJECT_SIGMA`; None if no further residual was
    rejected."""
    result = []
    for block, before in zip(blocks, accepted_masks, strict=True):
        size = groups[block.group].rejects
        limit = REJECT_SIGMA * factors[block.group] / np.sqrt(size or 1)
        good = np.repeat(_observations(block.residuals, size) <= limit, size) if size else before
        result.append(before & good)
    is_unchanged = all((a == b).all() for a, b in zip(result, accepted_masks, strict=True))
    return None if is_unchanged else result


def _summary(
    problem: _Problem[S],
    state: S,
    blocks: list[Block],
    accepted_masks: list[np.ndarray[tuple[int], np.dtype[np.bool_]]],
    weights: Sequence[Floats],
    factors: Floats,
    steps: int,
) -> Adjusted[S]:
    matrices, _ = _normals(blocks, weights, len(problem.groups), problem.parameters)
    covariance = _covariance(matrices, factors, problem.calibration_name)
    components, contributions, redundancies = [], [], []
    for number, group in enumerate(problem.groups):
        information = matrices[number] / factors[number] ** 2
        contributions.append(np.einsum("ij,jk,ki->i", covariance, information, covariance, optimize=True))
        chi2, count = _chi2(blocks, accepted_masks, number)
        whole = sum(len(block.residuals) for block in blocks if block.group == number)
        redundancy = count - float(np.sum(covariance * information))
        has_redundancy = group.is_estimated and redundancy >= _LEAST_REDUNDANCY
        redundancies.append(redundancy if has_redundancy else np.inf)
        size = group.rejects or 1
        components.append(Component(group.name, float(factors[number]), (whole - count) // size, redundancy, chi2))
    shares = np.asarray(contributions) / np.diag(covariance)
    freedom = np.maximum(np.asarray(redundancies), 1e-9)[:, None]
    degrees = 1.0 / np.maximum(np.sum(shares**2 / freedom, axis=0), 1e-12)
    return Adjusted(
        state,
        covariance,
        tuple(components),
        shares,
        degrees,
        tuple(block.residuals for block in blocks),
        tuple(accepted_masks),
        steps,
    )

"""Errors of a model that are found in the structure of its residuals, and their effect on values and
uncertainties.

A least-squares fit treats residuals as independent noise. If the model has no term for a cause, the cause leaves a
pattern in the residuals: over the field, over the board, from view to view. Each suspected cause is a set of modes
with one unknown amplitude, r = sum_k F_k c_k + noise with c_k ~ N(0, s_k^2). Amplitudes and noise maximise the
likelihood of the residuals (restricted maximum likelihood: Patterson and Thompson, Biometrika 58, 1971). Then the
modes are unknowns like all others, with this prior. They change the result, and widen its covariance as far as the
residuals allow. Kennedy and O'Hagan (J. R. Stat. Soc. B 63, 2001) treat the error of a model in this way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from coupole.calibration.adjustment import Block
from coupole.calibration.rotations import Floats

_NULL = 1e-7
"""Least share of the information in one direction of the space of the modes. With less, the direction belongs to
the model itself."""
_LEAST_LOG = -60.0
_ROUNDS, _SETTLED = 8, 0.01
_FARTHER = (0.0, 7.0, 13.0)
"""Logarithms of the variances from which the search for the amplitudes begins, above those that noise alone gives.
If priors share a pattern with a suspect, there are several minima."""


@dataclass(frozen=True)
class Suspect:
    """A cause for which the model has no term: derivatives [observations, modes] of the computed values, divided
    by the stated noise, in the order of the blocks of the group."""

    name: str
    modes: Floats


@dataclass(frozen=True)
class Search:
    """Rules by which suspects are judged."""

    group: int = 0
    """The group of residuals that they explain."""
    priors: tuple[int, ...] = ()
    """Groups that are priors of parameters: a suspect may explain why parameters are far from them."""
    doubtful: float = 0.0
    """A suspect with less evidence than this counts for nothing."""


@dataclass(frozen=True)
class Suspected:
    """One suspect, as judged by the evidence of the residuals."""

    name: str
    amplitude: float
    """Standard deviation of its modes' coefficients."""
    evidence: float
    """Twice the increase of log-likelihood that it brings."""
    coefficients: Floats
    """[modes] most probable coefficients."""
    coefficient_covariance: Floats
    pattern: float
    """Root mean square of its pattern in the residuals, divided by the stated noise. The part that the model
    absorbs is left out."""


@dataclass(frozen=True)
class ModelError:
    """The fit with the suspects as unknowns."""

    step: Floats
    """[p] change of the parameters."""
    covariance: Floats
    """[p, p]."""
    noise: float
    """Noise of the group without the patterns, divided by the stated noise."""
    suspects: tuple[Suspected, ...]
    coefficients: Floats
    """[modes] coefficients of all suspects together, in their order."""
    joint_covariance: Floats
    """[p + modes, p + modes] covariance of the parameters and all coefficients."""

    def of(self, name: str) -> Suspected:
        return next(suspect for suspect in self.suspects if suspect.name == name)


def with_suspects(
    blocks: Sequence[Block],
    weights: Sequence[Floats],
    factors: Floats,
    parameters: int,
    redundancy: float,
    suspects: Sequence[Suspect],
    search: Search = Search(),
) -> ModelError:
    """Judge the suspects by the residuals of the search's group, at the solution of an adjustment.

    `weights` are 1 for a residual that was kept, otherwise 0. `factors` [groups] are the estimated noises, divided
    by the stated ones. `redundancy` is that of the group.
    """
    group = search.group
    noise = float(factors[group])
    for _ in range(_ROUNDS):
        scaled_factors = factors.copy()
        scaled_factors[group] = noise
        fit = _Fit(blocks, weights, scaled_factors, parameters, suspects, search)
        logs = fit.most_likely(redundancy, [True] * len(suspects))
        again = noise * float(np.exp(0.5 * logs[0]))
        is_settled = abs(again / noise - 1.0) < _SETTLED
        noise = again
        if is_settled:
            break
    return fit.result(logs, redundancy, noise, search.doubtful)


class _Fit:
    """Normal equations with the modes, after elimination of the parameters. The group's noise is 1 here.

    With another noise than that of the adjustment, priors have another weight: the parameters first take the step
    to the solution with this noise."""

    def __init__(
        self,
        blocks: Sequence[Block],
        weights: Sequence[Floats],
        factors: Floats,
        parameters: int,
        suspects: Sequence[Suspect],
        search: Search,
    ) -> None:
        self.suspects, group = suspects, search.group
        modes = np.concatenate([suspect.modes for suspect in suspects], axis=1) / factors[group]
        self.of_mode = np.repeat(np.arange(len(suspects)), [suspect.modes.shape[1] for suspect in suspects])
        normal, slope = np.zeros((parameters, parameters)), np.zeros(parameters)
        for block, weight in zip(blocks, weights, strict=True):
            jacobian = block.jacobian / factors[block.group]
            normal[np.ix_(block.columns, block.columns)] += (jacobian * weight[:, None]).T @ jacobian
            slope[block.columns] += jacobian.T @ (weight * block.residuals) / factors[block.group]
        self.covariance = np.asarray(cho_solve(cho_factor(normal), np.eye(parameters)))
        self.settled_step = self.covariance @ slope
        cross, gram, side = np.zeros((parameters, modes.shape[1])), 0.0, np.zeros(modes.shape[1])
        self.chi2, first = 0.0, 0
        self._own: list[tuple[Floats, Block, Floats, slice]] = []
        for block, weight in zip(blocks, weights, strict=True):
            jacobian = block.jacobian / factors[block.group]
            residuals = block.residuals / factors[block.group] - jacobian @ self.settled_step[block.columns]
            if block.group in (group, *search.priors):
                self.chi2 += float(weight @ residuals**2)
            if block.group != group:
                continue
            rows = slice(first, first + len(weight))
            first += len(weight)
            weighted_modes = modes[rows] * weight[:, None]
            cross[block.columns] += jacobian.T @ weighted_modes
            gram = gram + modes[rows].T @ weighted_modes
            side += weighted_modes.T @ residuals
            self._own.append((jacobian, block, weight, rows))
        self.modes, self.cross = modes, cross
        remaining_gram = gram - cross.T @ self.covariance @ cross
        values, vectors = np.linalg.eigh(0.5 * (remaining_gram + remaining_gram.T))
        usable = values > _NULL * max(float(np.max(np.diag(gram))), 1e-300)
        self.root = np.sqrt(values[usable])[:, None] * vectors[:, usable].T
        self.seen = (vectors[:, usable].T @ side) / np.sqrt(values[usable])

    def _prior_variances(self, logs: Floats) -> Floats:
        """Return [modes] prior variances."""
        return np.asarray(np.exp(logs[1:])[self.of_mode])

    def _variance(self, logs: Floats) -> Floats:
        return np.asarray(
            np.exp(logs[0]) * np.eye(len(self.seen)) + (self.root * self._prior_variances(logs)) @ self.root.T
        )

    def minus_twice_log_likelihood(self, logs: Floats, redundancy: float) -> float:
        """Return minus twice the log-likelihood. The arguments are the logarithms of the noise's variance and of
        the suspects' squared amplitudes."""
        factor = cho_factor(self._variance(logs), lower=True)
        modes_part = 2.0 * float(np.sum(np.log(np.diag(factor[0])))) + float(
            self.seen @ cho_solve(factor, self.seen)
        )
        rest = max(redundancy - len(self.seen), 1.0)
        unexplained_chi2 = max(self.chi2 - float(self.seen @ self.seen), 0.0)
        return modes_part + rest * float(logs[0]) + unexplained_chi2 * float(np.exp(-logs[0]))

    def most_likely(self, redundancy: float, allowed_suspects: Sequence[bool]) -> Floats:
        """Return [1 + suspects], the most likely of these logarithms. Suspects that are not allowed have none."""
        free = np.flatnonzero([True, *allowed_suspects])
        start = np.full(1 + len(self.suspects), _LEAST_LOG)
        start[0] = 0.0
        for number in np.flatnonzero(allowed_suspects):
            information = np.mean(np.sum(self.root[:, self.of_mode == number] ** 2, axis=0))
            start[1 + number] = -np.log(max(float(information), 1e-12))
        bounds = [(-12.0, 3.0) if place == 0 else (start[place] - 14.0, start[place] + 14.0) for place in free]

        def cost(values: Floats) -> tuple[float, Floats]:
            logs = start.copy()
            logs[free] = values
            return self.minus_twice_log_likelihood(logs, redundancy), self._slopes(logs, redundancy)[free]

        farther = [np.where(free == 0, 0.0, more) for more in (_FARTHER if len(free) > 1 else _FARTHER[:1])]
        minima = [
            minimize(cost, start[free] + more, jac=True, method="L-BFGS-B", bounds=bounds) for more in farther
        ]
        best = start.copy()
        best[free] = min(minima, key=lambda minimum: float(minimum.fun)).x
        return best

    def _slopes(self, logs: Floats, redundancy: float) -> Floats:
        """Return [1 + suspects] derivatives of `minus_twice_log_likelihood` by the logarithms."""
        inverse = np.linalg.inv(self._variance(logs))
        along = inverse @ self.seen
        noise_variance = float(np.exp(logs[0]))
        rest = max(redundancy - len(self.seen), 1.0)
        unexplained_chi2 = max(self.chi2 - float(self.seen @ self.seen), 0.0)
        by_noise = noise_variance * (np.trace(inverse) - along @ along) + rest - unexplained_chi2 / noise_variance
        by_mode = np.einsum("im,ij,jm->m", self.root, inverse, self.root) - (self.root.T @ along) ** 2
        by_suspect = np.bincount(self.of_mode, self._prior_variances(logs) * by_mode, len(self.suspects))
        return np.concatenate([[by_noise], by_suspect])

    def result(self, logs: Floats, redundancy: float, noise: float, doubtful: float) -> ModelError:
        logs, evidence = self._without_doubtful(logs, redundancy, doubtful)
        variances = self._prior_variances(logs)
        factor = cho_factor(self._variance(logs))
        gain = variances[:, None] * self.root.T
        coefficients = gain @ cho_solve(factor, self.seen)
        covariance = np.diag(variances) - gain @ cho_solve(factor, gain.T)
        by = self.covariance @ self.cross
        step = self.settled_step - by @ coefficients
        suspects = []
        for number, suspect in enumerate(self.suspects):
            own_modes = self.of_mode == number
            pattern = self._pattern(np.where(own_modes, coefficients, 0.0), by)
            suspects.append(
                Suspected(
                    suspect.name,
                    float(np.exp(0.5 * logs[1 + number])),
                    float(evidence[number]),
                    coefficients[own_modes],
                    covariance[np.ix_(own_modes, own_modes)],
                    pattern * noise,
                )
            )
        parameters = self.covariance + by @ covariance @ by.T
        between = -by @ covariance
        joint = np.block([[parameters, between], [between.T, covariance]])
        return ModelError(step, parameters, noise, tuple(suspects), coefficients, joint)

    def _without_doubtful(self, logs: Floats, redundancy: float, doubtful: float) -> tuple[Floats, Floats]:
        """Return the logarithms, and the evidence [suspects] of each suspect with all others present. The weakest
        suspect is left out as long as its evidence is below `doubtful`."""
        present = np.ones(len(self.suspects), np.bool_)
        while True:
            evidence = self._evidence(logs, redundancy, present)
            weakest = int(np.argmin(np.where(present, evidence, np.inf)))
            if not present.any() or evidence[weakest] >= doubtful:
                return logs, evidence
            present[weakest] = False
            logs = self.most_likely(redundancy, present.tolist())

    def _evidence(self, logs: Floats, redundancy: float, present: NDArray[np.bool_]) -> Floats:
        """Return [suspects] twice the log-likelihood that each brings with all others present."""
        at_best = self.minus_twice_log_likelihood(logs, redundancy)
        evidence = np.zeros(len(self.suspects))
        for number in np.flatnonzero(present):
            other_suspects = [bool(there) and suspect != number for suspect, there in enumerate(present)]
            without = self.most_likely(redundancy, other_suspects)
            evidence[number] = max(self.minus_twice_log_likelihood(without, redundancy) - at_best, 0.0)
        return evidence

    def _pattern(self, coefficients: Floats, by: Floats) -> float:
        """Return the root mean square of the pattern that these coefficients leave in the residuals."""
        step = -by @ coefficients
        total, count = 0.0, 0
        for jacobian, block, weight, rows in self._own:
            pattern = self.modes[rows] @ coefficients + jacobian @ step[block.columns]
            total += float(weight @ pattern**2)
            count += int(weight.sum())
        return float(np.sqrt(total / max(count, 1)))

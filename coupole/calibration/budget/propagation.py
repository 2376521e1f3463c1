"""Propagation of distributions by GUM's linear formula and by Monte Carlo, and a test of the linear formula.

The linear formula is that of JCGM 100:2008 (GUM), section 5. Monte Carlo follows JCGM 101:2008 (Supplement 1):
adaptive number of trials (7.9), coverage intervals (7.7), test of the linear formula (8). A model is a function of
arrays. It takes one array [trials] for each quantity and returns one array, so a million trials are one call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

Shape = Literal["normal", "student", "rectangular", "triangular", "arcsine"]
Model = Callable[[Mapping[str, Floats]], Floats]
_LEAST_BATCH = 10_000
_ADVISED = 0.2
"""Advised numerical accuracy of Monte Carlo's ends for a validation, as a share of the tolerance (JCGM 101,
8.2)."""
_STEP = 1e-3
"""Step of central differences, as a share of a standard uncertainty."""
COVERAGES = (0.68, 0.95)


@dataclass(frozen=True)
class Quantity:
    """One input of a measurement."""

    name: str
    """Name with its unit."""
    value: float
    u: float
    """Standard uncertainty, in the name's unit."""
    shape: Shape = "normal"
    source: str = ""
    """The record or document that gives value and u."""
    group: str = ""
    """Inputs of one group count as one source of uncertainty; if empty, the input is a group by itself."""
    degrees_of_freedom: float = np.inf
    """Degrees of freedom of Student's distribution."""

    @property
    def source_group(self) -> str:
        return self.group or self.name


@dataclass(frozen=True)
class Inputs:
    """The quantities of a model, and how they are correlated."""

    quantities: tuple[Quantity, ...]
    correlations: tuple[tuple[str, str, float], ...] = ()
    """Coefficients of pairs of normal quantities; all others are independent."""

    def matrix(self) -> Floats:
        """Correlation matrix [n, n]. Raises InputError if a pair does not exist or is not normal, or if the matrix
        is not positive semidefinite."""
        names = [q.name for q in self.quantities]
        matrix = np.eye(len(names))
        for first, second, coefficient in self.correlations:
            for name in (first, second):
                if name not in names:
                    raise InputError(
                        f"budget: correlation of `{name}`: no such input; there are {', '.join(names)}"
                    )
                if self.quantities[names.index(name)].shape != "normal":
                    raise InputError(f"budget: correlation of `{name}`: only normal inputs can be correlated here")
            i, j = names.index(first), names.index(second)
            matrix[i, j] = matrix[j, i] = coefficient
        if np.linalg.eigvalsh(matrix)[0] < -1e-9:
            raise InputError(
                "budget: no quantities can have these correlations: their matrix has a negative eigenvalue"
            )
        return matrix

    def values(self) -> dict[str, float]:
        return {q.name: q.value for q in self.quantities}


@dataclass(frozen=True)
class Interval:
    """A coverage interval, given by its ends."""

    coverage: float
    low: float
    high: float
    kind: Literal["symmetric", "shortest", "normal"]
    """Probabilistically symmetric, shortest, or from the linear formula."""
    numerical: float = 0.0
    """Numerical accuracy: twice the standard deviation of the worse end, from the scatter of the batches; 0 for
    the linear formula."""


@dataclass(frozen=True)
class Propagated:
    """Distribution of the output by one propagation."""

    estimate: float
    u: float
    intervals: tuple[Interval, ...]
    trials: int
    """Number of trials; 0 for the linear formula."""
    samples: Floats
    """[trials] sorted; empty for the linear formula."""
    stable: bool = True
    """False if the number of trials was too small for the requested digits."""

    def interval(self, coverage: float, kind: str) -> Interval:
        return next(i for i in self.intervals if i.coverage == coverage and i.kind == kind)


@dataclass(frozen=True)
class Linear:
    """GUM's propagation, with the contribution of each input."""

    result: Propagated
    sensitivities: Floats
    """[inputs] derivative of the output by each input."""
    shares: Floats
    """[inputs] shares of the variance, which sum to 1. The term of a correlated pair is divided equally between
    both."""
    degrees_of_freedom: float
    """Effective degrees of freedom (Welch-Satterthwaite, GUM G.4), for independent inputs only."""


@dataclass(frozen=True)
class Validation:
    """Result of the test of the linear formula (JCGM 101, section 8), for u with a number of significant
    digits."""

    coverage: float
    digits: int
    d_low: float
    d_high: float
    """Distance of the linear interval's ends from Monte Carlo's."""
    tolerance: float
    """Numerical tolerance of u with this number of digits (7.9.2)."""
    numerical: float
    """Numerical accuracy of Monte Carlo's ends; 8.2 advises a fifth of the tolerance."""

    @property
    def is_within_tolerance(self) -> bool:
        return max(self.d_low, self.d_high) <= self.tolerance

    @property
    def sure(self) -> bool:
        """True if more trials would not change the verdict."""
        apart = abs(max(self.d_low, self.d_high) - self.tolerance)
        return self.numerical <= max(_ADVISED * self.tolerance, apart)


def linear(model: Model, inputs: Inputs, coverages: Sequence[float] = COVERAGES) -> Linear:
    """Apply GUM 5.2: u^2 = sum_ij c_i c_j u_i u_j r_ij, with derivatives by central differences."""
    values = inputs.values()
    estimate = float(model({name: np.array([value]) for name, value in values.items()})[0])
    u = np.array([q.u for q in inputs.quantities])
    sensitivities = np.zeros(len(u))
    for i, q in enumerate(inputs.quantities):
        step = _STEP * q.u
        if step == 0.0:
            continue
        ends = {name: np.full(2, value) for name, value in values.items()}
        ends[q.name] = q.value + np.array([-step, step])
        low, high = model(ends)
        sensitivities[i] = (high - low) / (2 * step)
    parts = sensitivities * u
    terms = parts[:, None] * inputs.matrix() * parts
    variance = float(terms.sum())
    combined_u = float(np.sqrt(max(variance, 0.0)))
    dof = np.array([q.degrees_of_freedom for q in inputs.quantities])
    fourth = float(np.sum(parts**4 / dof))
    effective = variance**2 / fourth if fourth > 0.0 else float("inf")
    intervals = []
    for coverage in coverages:
        k = float(stdtrit(min(effective, 1e6), 0.5 + coverage / 2))
        intervals.append(Interval(coverage, estimate - k * combined_u, estimate + k * combined_u, "normal"))
    shares = terms.sum(axis=1) / variance if variance > 0.0 else np.zeros(len(u))
    result = Propagated(estimate, combined_u, tuple(intervals), 0, np.zeros(0))
    return Linear(result, sensitivities, shares, effective)


def monte_carlo(
    model: Model,
    inputs: Inputs,
    *,
    coverages: Sequence[float] = COVERAGES,
    digits: int = 2,
    within: float = 1.0,
    most_trials: int = 4_000_000,
    seed: int = 1,
) -> Propagated:
    """Run batches of trials until mean, u and the ends of the intervals are stable (JCGM 101, 7.9.4).

    A figure is stable if two standard deviations of its mean over the batches are at most `within` times the
    numerical tolerance of u for the number of significant `digits`. A validation needs 0.2 (8.2). Raises
    InputError if the model returns NaN.
    """
    batch = max(_LEAST_BATCH, int(np.ceil(100.0 / (1.0 - max(coverages)))))
    random = np.random.default_rng(seed)
    half = _root(inputs.matrix())
    batches: list[Floats] = []
    figures: list[list[float]] = []
    scatter = np.full(2 + 2 * len(coverages), np.inf)
    stable = False
    while not stable and (len(batches) + 1) * batch <= max(most_trials, batch):
        samples = _sorted_values(model(draw(inputs, half, batch, random)))
        batches.append(samples)
        limits = [end for p in coverages for end in ends(samples, p)]
        figures.append([float(samples.mean()), float(samples.std(ddof=1)), *limits])
        if len(batches) > 1:
            table = np.array(figures)
            scatter = 2.0 * table.std(axis=0, ddof=1) / np.sqrt(len(batches))
            stable = bool(
                (scatter <= within * tolerance(_pooled_uncertainty(table[:, 0], table[:, 1]), digits)).all()
            )
    samples = np.sort(np.concatenate(batches))
    intervals = []
    for p, numerical in zip(coverages, scatter[2:].reshape(-1, 2).max(axis=1), strict=True):
        intervals.append(Interval(p, *ends(samples, p), "symmetric", float(numerical)))
        intervals.append(Interval(p, *_shortest(samples, p), "shortest", float(numerical)))
    mean, u = float(samples.mean()), float(samples.std(ddof=1))
    return Propagated(mean, u, tuple(intervals), len(samples), samples, stable)


def _pooled_uncertainty(means: Floats, batch_uncertainties: Floats) -> float:
    """Return u of all trials so far (7.9.4, step j), from means and u of batches of equal size."""
    return float(np.sqrt(np.mean(batch_uncertainties**2) + np.var(means)))


def trials_of(
    model: Model, inputs: Inputs, trials: int, seed: int = 1, fixed_groups: frozenset[str] = frozenset()
) -> Floats:
    """Return [trials] sorted values of the output. Inputs of the groups `fixed_groups` keep their values. The
    others get the same random numbers as if no input were fixed. Up to 1 % of the values may be infinite; this
    does not change the ends of intervals. Raises InputError if more are infinite, or if one is NaN."""
    random = np.random.default_rng(seed)
    return _sorted_values(model(draw(inputs, _root(inputs.matrix()), trials, random, fixed_groups)), infinite=0.01)


def validate(linear_result: Propagated, numeric: Propagated, *, digits: int = 1) -> tuple[Validation, ...]:
    """Compare the ends of the linear intervals with Monte Carlo's, within the tolerance of u (JCGM 101, 8.1)."""
    validations = []
    for interval in linear_result.intervals:
        numeric_interval = numeric.interval(interval.coverage, "symmetric")
        validations.append(
            Validation(
                interval.coverage,
                digits,
                abs(interval.low - numeric_interval.low),
                abs(interval.high - numeric_interval.high),
                tolerance(numeric.u, digits),
                numeric_interval.numerical,
            )
        )
    return tuple(validations)


def tolerance(u: float, digits: int) -> float:
    """Return the numerical tolerance of u: half a unit of its last significant digit (JCGM 101, 7.9.2)."""
    if u <= 0.0:
        return 0.0
    power = np.floor(np.log10(u)) - (digits - 1)
    if round(u / 10.0**power) >= 10**digits:  # 0.0996 has the digits 10 and the power -2
        power += 1
    return float(0.5 * 10.0**power)


def draw(
    inputs: Inputs,
    half: Floats,
    trials: int,
    random: np.random.Generator,
    fixed_groups: frozenset[str] = frozenset(),
) -> dict[str, Floats]:
    """Draw samples [trials] of each quantity (JCGM 101, section 6.4). `half` [n, n] is a root of the correlation
    matrix. The half widths of bounded distributions are those of JCGM 101, table 1."""
    normal = random.standard_normal((trials, len(inputs.quantities))) @ half.T
    samples = {}
    for i, q in enumerate(inputs.quantities):
        if q.shape == "normal":
            standard = normal[:, i]
        elif q.shape == "student":
            standard = random.standard_t(q.degrees_of_freedom, trials)
        elif q.shape == "rectangular":
            standard = np.sqrt(3.0) * random.uniform(-1.0, 1.0, trials)
        elif q.shape == "triangular":
            standard = np.sqrt(6.0) * random.triangular(-1.0, 0.0, 1.0, trials)
        else:
            standard = np.sqrt(2.0) * np.sin(2.0 * np.pi * random.random(trials))
        samples[q.name] = q.value + (0.0 if q.source_group in fixed_groups else q.u) * standard
    return samples


def _sorted_values(values: Floats, *, infinite: float = 0.0) -> Floats:
    """Return the sorted values. Raises InputError if more than the share `infinite` of the values is infinite, or
    if one value is NaN."""
    if np.isnan(values).any() or float(np.mean(np.isinf(values))) > infinite:
        raise InputError(
            f"budget: {np.mean(~np.isfinite(values)):.2%} of the trials give no finite value: an input's "
            "distribution includes values for which the measurement equation has no meaning, for example a "
            "light below the horizon"
        )
    return np.sort(values)


def _root(correlation: Floats) -> Floats:
    values, vectors = np.linalg.eigh(correlation)
    root: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def ends(sorted_samples: Floats, coverage: float) -> tuple[float, float]:
    """Return the ends of the probabilistically symmetric interval of sorted samples (JCGM 101, 7.7.2)."""
    count = len(sorted_samples)
    inside = round(coverage * count)
    first = (count - inside) // 2
    return float(sorted_samples[first]), float(sorted_samples[first + inside])


def _shortest(sorted_samples: Floats, coverage: float) -> tuple[float, float]:
    """Return the ends of the shortest interval (JCGM 101, 7.7.4)."""
    inside = round(coverage * len(sorted_samples))
    widths = sorted_samples[inside:] - sorted_samples[:-inside]
    first = int(np.argmin(widths))
    return float(sorted_samples[first]), float(sorted_samples[first + inside])

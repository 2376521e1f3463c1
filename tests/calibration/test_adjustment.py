"""Least squares against closed forms: means of n values, and lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coupole.calibration.adjustment import Adjusted, Block, Group, adjust, coverage_factor
from coupole.errors import InputError

VALUES = np.array([3.1, 2.9, 3.4, 3.0, 2.6, 3.3, 3.2, 2.7])


def mean_of(values: Any, stated: float, *, estimated: bool = True) -> Adjusted[Any]:
    """One parameter, seen once by each value with the stated noise."""

    def evaluate(state: Any) -> list[Block]:
        ones = np.full((len(values), 1), 1.0 / stated)
        return [Block((values - state[0]) / stated, ones, np.array([0]), 0)]

    groups = [Group("values", estimated)]
    return adjust(np.zeros(1), evaluate, lambda state, step: state + step, groups, 1, calibration_name="a mean")


def test_the_variance_of_a_mean_is_that_of_the_values_over_their_number() -> None:
    found = mean_of(VALUES, 1.0)
    assert found.state[0] == pytest.approx(VALUES.mean(), abs=1e-9)
    assert found.covariance[0, 0] == pytest.approx(VALUES.var(ddof=1) / len(VALUES), rel=2e-3)
    assert found.factor("values") == pytest.approx(VALUES.std(ddof=1), rel=1e-3)
    assert found.degrees[0] == pytest.approx(len(VALUES) - 1)


def test_where_the_noise_is_stated_the_variance_is_the_stated_one_over_the_number() -> None:
    found = mean_of(VALUES, 0.5, estimated=False)
    assert found.covariance[0, 0] == pytest.approx(0.25 / len(VALUES), rel=1e-9)
    assert found.components[0].factor == 1.0
    chi2 = found.components[0].chi2 / found.components[0].redundancy
    assert chi2 == pytest.approx(4 * VALUES.var(ddof=1))


def test_a_stated_noise_that_is_estimated_makes_no_difference() -> None:
    assert mean_of(VALUES, 7.0).covariance[0, 0] == pytest.approx(mean_of(VALUES, 0.1).covariance[0, 0], rel=5e-3)


def test_two_groups_are_weighted_by_their_noise_and_share_the_variance_by_it() -> None:
    """Two values of noise 1 and 3: the weighted mean of textbooks."""

    def evaluate(state: Any) -> list[Block]:
        at = np.array([0])
        return [
            Block(np.array([10.0 - state[0]]), np.ones((1, 1)), at, 0),
            Block(np.array([20.0 - state[0]]) / 3, np.ones((1, 1)) / 3, at, 1),
        ]

    groups = [Group("fine", is_estimated=False), Group("coarse", is_estimated=False)]
    found = adjust(np.zeros(1), evaluate, lambda state, step: state + step, groups, 1, calibration_name="a mean")
    assert found.state[0] == pytest.approx(11.0, abs=1e-6)
    assert found.covariance[0, 0] == pytest.approx(0.9)
    assert found.contributions[:, 0] == pytest.approx([0.9, 0.1])


def test_a_line_through_points_has_the_covariance_of_textbooks() -> None:
    x = np.array([0.0, 1.0, 2.0, 4.0, 7.0, 8.0, 9.5])
    y = np.array([1.0, 2.2, 2.8, 5.3, 7.9, 9.2, 10.1])

    def evaluate(state: Any) -> list[Block]:
        return [Block(y - state[0] - state[1] * x, np.column_stack([np.ones(len(x)), x]), np.array([0, 1]), 0)]

    found = adjust(
        np.zeros(2),
        evaluate,
        lambda s, step: s + step,
        [Group("y", is_estimated=True)],
        2,
        calibration_name="a line",
    )
    expected, covariance = np.polyfit(x, y, 1, cov=True)
    assert found.state[::-1] == pytest.approx(expected, abs=1e-6)
    assert found.covariance[::-1, ::-1] == pytest.approx(covariance, rel=2e-3)


def test_gross_errors_are_left_out_and_counted() -> None:
    values = np.append(np.tile(VALUES, 8), [9.0, -4.0])

    def evaluate(state: Any) -> list[Block]:
        return [Block(values - state[0], np.ones((len(values), 1)), np.array([0]), 0)]

    groups = [Group("values", is_estimated=True, rejects=1)]
    found = adjust(np.zeros(1), evaluate, lambda state, step: state + step, groups, 1, calibration_name="a mean")
    assert found.components[0].rejected_count == 2
    assert found.state[0] == pytest.approx(VALUES.mean(), abs=1e-9)
    assert found.covariance[0, 0] == pytest.approx(np.tile(VALUES, 8).var(ddof=1) / 64, rel=2e-3)


def test_a_parameter_that_nothing_determines_is_refused() -> None:
    def evaluate(state: Any) -> list[Block]:
        return [Block(VALUES - state[0] - state[1], np.ones((8, 2)), np.array([0, 1]), 0)]

    with pytest.raises(InputError, match="do not determine all parameters"):
        adjust(
            np.zeros(2),
            evaluate,
            lambda s, step: s + step,
            [Group("y", is_estimated=True)],
            2,
            calibration_name="two",
        )


@pytest.mark.parametrize("width", [1e-8, 1e-6])
def test_a_parameter_that_is_hardly_determined_is_refused_too(width: float) -> None:
    """By 1e-8 the normal matrix has no Cholesky factor in double precision, by 1e-6 it has one."""
    x = np.linspace(0.0, width, 8)

    def evaluate(state: Any) -> list[Block]:
        columns = np.column_stack([np.ones(8), 1.0 + x])
        return [Block(VALUES - columns @ state, columns, np.array([0, 1]), 0)]

    with pytest.raises(InputError, match="do not determine all parameters"):
        adjust(
            np.zeros(2),
            evaluate,
            lambda s, step: s + step,
            [Group("y", is_estimated=True)],
            2,
            calibration_name="two",
        )


def test_each_groups_share_of_a_variance_is_what_its_noise_brings_into_the_parameter() -> None:
    """A line through fine and coarse points: by the weights with which each point enters the result."""
    x, sigma = np.array([0.0, 1.0, 2.0, 5.0, 9.0]), np.array([1.0, 1.0, 3.0, 3.0, 3.0])
    y = 2.0 * x + 1.0
    columns = np.column_stack([np.ones(5), x]) / sigma[:, None]

    def evaluate(state: Any) -> list[Block]:
        off, both = y / sigma - columns @ state, np.array([0, 1])
        return [Block(off[:2], columns[:2], both, 0), Block(off[2:], columns[2:], both, 1)]

    groups = [Group("fine", is_estimated=False), Group("coarse", is_estimated=False)]
    found = adjust(np.zeros(2), evaluate, lambda s, step: s + step, groups, 2, calibration_name="a line")
    enters = np.linalg.pinv(columns)
    fine, coarse = (enters[:, :2] ** 2).sum(axis=1), (enters[:, 2:] ** 2).sum(axis=1)
    assert found.contributions[0] == pytest.approx(fine / (fine + coarse))
    assert found.contributions[1] == pytest.approx(coarse / (fine + coarse))


def test_the_coverage_factor_is_students() -> None:
    """GUM, table G.2."""
    assert coverage_factor(np.array([1.0, 5.0, 10.0])) == pytest.approx([12.706, 2.571, 2.228], abs=6e-4)
    assert float(coverage_factor(1e9)) == pytest.approx(1.959964, abs=1e-5)

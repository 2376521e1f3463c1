"""How much pairs by themselves enlarge the uncertainties of all poses: by the usual pair, not by the worst."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from lazily import lazily

from coupole.scan.registration.joint_fit import JointFit
from coupole.scan.registration.loop_errors import PairAlone, sliding_pairs, with_loops

stats: Any = lazily("scipy.stats")
SCANS = 40
PAIRS = [(a, b) for a in range(SCANS) for b in range(a + 1, SCANS)]
"""So many that what all have in common is a small part of each pair's difference."""
OVERLAPS, TARGETS = 4.0, 9.0
"""Parts of the variance, mm2."""


def fit() -> JointFit:
    one = np.eye(6 * SCANS)
    return JointFit(
        [np.eye(4)] * SCANS, (OVERLAPS + TARGETS) * one, OVERLAPS * one, np.zeros((SCANS, 3)), 1, 1, 1, 1, ()
    )


def pairs_that_differ(factor: float, wrong: int = 0) -> list[PairAlone]:
    """Sums of squares of six normal errors each, `factor` larger than stated; some pairs are far away."""
    rng = np.random.default_rng(7)
    loops_share = (len(PAIRS) - SCANS + 1) / len(PAIRS)
    surprises = loops_share * factor**2 * np.sum(rng.normal(size=(len(PAIRS), 6)) ** 2, axis=1)
    surprises[rng.permutation(len(PAIRS))[:wrong]] = 1e5
    return [PairAlone(*pair, np.eye(4), value) for pair, value in zip(PAIRS, surprises, strict=True)]


@pytest.mark.parametrize("true_factor", [1.0, 1.7, 3.0])
def test_the_factor_is_that_of_the_errors(true_factor: float) -> None:
    assert with_loops(fit(), pairs_that_differ(true_factor), SCANS)[1] == pytest.approx(true_factor, rel=0.05)


def test_a_tenth_of_pairs_that_slide_away_hardly_changes_it_and_is_named() -> None:
    wrong = len(PAIRS) // 10
    pairs = pairs_that_differ(1.7, wrong)
    factor = with_loops(fit(), pairs, SCANS)[1]
    assert factor == pytest.approx(1.7, rel=0.1)
    named = sliding_pairs(pairs, factor)
    assert [pair.surprise for pair in named] == [1e5] * wrong


def test_errors_as_large_as_stated_enlarge_nothing_and_name_no_pair() -> None:
    small = [replace(pair, surprise=0.3 * pair.surprise) for pair in pairs_that_differ(1.0)]
    enlarged, factor = with_loops(fit(), small, SCANS)
    assert factor == 1.0
    np.testing.assert_array_equal(enlarged.covariance, fit().covariance)
    assert sliding_pairs(pairs_that_differ(1.0), 1.0) == []


def test_what_targets_say_is_not_enlarged() -> None:
    enlarged, factor = with_loops(fit(), pairs_that_differ(3.0), SCANS)
    variance_mm2 = np.diag(enlarged.covariance)
    np.testing.assert_allclose(variance_mm2, factor**2 * OVERLAPS + TARGETS)
    np.testing.assert_allclose(np.diag(enlarged.overlap_covariance), factor**2 * OVERLAPS)


def test_the_three_pairs_of_one_loop_share_its_error() -> None:
    """Each takes a third of the squared error, so what is left of a pair is smaller than its own error."""
    usual = stats.chi2.median(6) / 3
    pairs = [PairAlone(*pair, np.eye(4), 4 * usual) for pair in ((0, 1), (0, 2), (1, 2))]
    assert with_loops(fit(), pairs, 3)[1] == pytest.approx(2.0)


def test_without_loops_nothing_is_known() -> None:
    chain = [PairAlone(k, k + 1, np.eye(4), 1e4) for k in range(SCANS - 1)]
    assert with_loops(fit(), chain, SCANS)[1] == 1.0

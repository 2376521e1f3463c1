"""Matching: no frame ever gets a wrong label, whatever is lost or added within the fault model."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from matching_takes import (
    MODEL,
    START,
    Take,
    assert_no_wrong_label,
    edge_us,
    examples,
    take,
    takes,
    whole_burst,
)
from numpy.typing import NDArray

from coupole.acquisition.frame_matching import UNLABELLED


@examples(times=10)
@given(takes())
def test_no_frame_of_a_finished_burst_gets_a_wrong_label(what: Take) -> None:
    assert_no_wrong_label(what, what.verdict())


@examples(times=5)
@given(takes(), st.integers(0, 2**32))
def test_no_frame_of_a_running_burst_gets_a_wrong_label_and_no_label_is_changed_later(
    what: Take, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    total = len(what.truth)
    labels = np.full(total, UNLABELLED)
    for frames in np.unique(rng.integers(1, total + 1, 12)) if total else ():
        fired = what.truth[:frames][what.truth[:frames] >= 0]
        # The log holds the steps of all frames that are here but for the last ones, or more.
        least = int(fired[-1 - MODEL.in_flight]) + 1 if len(fired) > MODEL.in_flight else 0
        most = int(np.searchsorted(what.edges_us, what.frames_us[frames - 1], side="right"))
        steps = int(rng.integers(least, max(least, most) + 1))
        verdict = what.verdict(complete=False, frames=frames, steps=steps)
        assert_no_wrong_label(what, verdict)
        assert_same_where_both(labels[:frames], verdict.step_of_frame)
        labels[:frames] = np.maximum(labels[:frames], verdict.step_of_frame)
    assert_same_where_both(labels, what.verdict().step_of_frame)


def assert_same_where_both(early: NDArray[np.int64], late: NDArray[np.int64]) -> None:
    both = (early >= 0) & (late >= 0)
    assert np.array_equal(early[both], late[both])


@examples(times=4)
@given(takes())
def test_a_step_is_called_missing_only_if_no_frame_of_it_is_here(what: Take) -> None:
    here = np.zeros(len(what.log), np.bool_)
    here[what.truth[what.truth >= 0]] = True
    assert not np.any(what.verdict().missing & here)


@examples(times=4)
@given(takes())
def test_a_step_is_called_lost_in_transfer_only_if_the_camera_counted_it(what: Take) -> None:
    assert not np.any(what.verdict().lost_in_transfer & ~what.exposed)


def test_a_surplus_frame_just_before_an_edge_never_takes_the_label_of_the_frame_that_follows() -> None:
    burst = whole_burst(1, 1_500_000, 0)
    what = take(burst, surplus_us=(edge_us(burst, START) - 250.0,), relative_ppm=0.0, jitter_us=0.0)
    assert_no_wrong_label(what, what.verdict())


def test_a_surplus_frame_in_place_of_a_missed_one_never_lets_a_wrong_alignment_win() -> None:
    here = {1, 5, 6, 8, 9}
    burst = whole_burst(5)
    what = take(
        burst,
        missed=tuple(set(range(len(burst.table))) - here),
        surplus_us=(-10_030.0, 20_030.0, edge_us(burst, 4) + 122.0),
        jitter_us=100.0,
        relative_ppm=0.0,
        seed=6,
    )
    labelled = what.verdict().step_of_frame[what.truth >= 0]
    assert set(labelled[labelled >= 0].tolist()) <= here

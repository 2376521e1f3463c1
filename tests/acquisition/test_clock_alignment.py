"""Which frames the clocks' common line cannot vouch for."""

from __future__ import annotations

import numpy as np

from coupole.acquisition.clock_alignment import DOUBTFUL, _leave_out, agree_on_steps

JITTER_NS = 100_000


def left_out(frame_ns: list[int], may_leave_out: int) -> tuple[bool, list[int]]:
    """Whether frames at these times fit steps 10 ms apart, and which of them are doubtful."""
    view = np.arange(len(frame_ns))
    steps_ns = 10_000_000 * np.arange(len(frame_ns))
    fits = _leave_out(np.array(frame_ns), steps_ns, view, may_leave_out, JITTER_NS)
    return bool(fits), np.flatnonzero(view == DOUBTFUL).tolist()


def test_frames_on_the_line_are_all_vouched_for() -> None:
    assert left_out([0, 10_050_000, 20_000_000], 1) == (True, [])


def test_every_frame_that_some_solution_leaves_out_is_doubtful() -> None:
    """Of three frames off their line, any one may be the wrong one; of many, only the one that is."""
    assert left_out([0, 10_300_000, 20_000_000], 1) == (True, [0, 1, 2])
    assert left_out([0, 10_300_000, 20_000_000, 30_000_000, 40_000_000, 50_000_000], 1) == (True, [1])


def test_more_frames_off_the_line_than_may_be_left_out_do_not_fit() -> None:
    assert left_out([0, 10_300_000, 20_000_000], 0) == (False, [])
    assert left_out([0, 10_300_000, 20_000_000, 30_400_000, 40_000_000, 50_000_000], 1)[0] is False


def test_two_frames_of_one_step_bend_no_line() -> None:
    """Neither is known to be the step's own; without them the others fit."""
    frame_ns = np.array([0, 10_000_000, 10_350_000, 20_000_000, 30_000_000, 40_000_000])
    view = np.array([0, 1, 1, 2, 3, 4])
    assert _leave_out(frame_ns, 10_000_000 * np.arange(5), view, 0, JITTER_NS)
    assert view.tolist() == [0, 1, 1, 2, 3, 4]


def candidates(frame_ns: list[int], max_surplus: int) -> int:
    """Number of alignments with ten steps 10 ms apart that leave so many frames unexplained, or fewer."""
    n = len(frame_ns)
    agreed, agrees = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    steps_ns = 10_000_000 * np.arange(10)
    return agree_on_steps(np.array(frame_ns), steps_ns, JITTER_NS, 5e-3, max_surplus, 0, agreed, agrees)


def test_a_surplus_frame_and_one_off_the_line_are_two_unexplained() -> None:
    clean = [10_000_000 * step for step in range(10)]
    one_off = [*clean[:5], 50_250_000, *clean[6:]]
    both = sorted([*one_off, 75_000_000])
    assert candidates(clean, 0) == 1
    assert candidates(one_off, 0) == 0
    assert candidates(one_off, 1) > 0
    assert candidates(both, 1) == 0
    assert candidates(both, 2) > 0

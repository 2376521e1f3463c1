"""Which frames the clocks' common line cannot vouch for."""

from __future__ import annotations

import numpy as np

from coupole.acquisition.clock_alignment import DOUBTFUL, _leave_out

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

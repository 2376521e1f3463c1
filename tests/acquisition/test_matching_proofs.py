"""Matching proves all that can be proven: clean bursts whole, and all but what was lost or doubled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matching_takes import (
    END,
    EXPOSURES_US,
    MAX_LIGHTS,
    MODEL,
    START,
    assert_all_proven,
    assert_no_wrong_label,
    bursts,
    edge_us,
    examples,
    take,
    whole_burst,
)

from coupole.plan.bursts import Burst

clocks = {
    "box_ppm": st.floats(-60, 60),
    "relative_ppm": st.floats(-99, 99),
    "jitter_us": st.floats(0, MODEL.jitter_us),
    "seed": st.integers(0, 2**32),
}


@examples(times=3)
@given(bursts(), st.fixed_dictionaries(clocks))
def test_a_clean_burst_is_proven_completely(burst: Burst, clock: dict[str, float]) -> None:
    what = take(burst, **clock)
    verdict = what.verdict()
    assert_all_proven(what, verdict)
    assert not verdict.missing.any()


@examples(times=3)
@given(st.integers(1, MAX_LIGHTS), st.sampled_from(EXPOSURES_US), st.fixed_dictionaries(clocks), st.data())
def test_up_to_five_percent_of_lost_transfers_leave_all_other_frames_proven(
    lights: int, exposure_us: int, clock: dict[str, float], data: st.DataObject
) -> None:
    burst = whole_burst(lights, exposure_us)
    steps = len(burst.table)
    most = max(1, steps // 20)
    lost = data.draw(st.lists(st.integers(START - 1, steps - END), max_size=most, unique=True))
    what = take(burst, lost=tuple(lost), **clock)
    verdict = what.verdict()
    assert_all_proven(what, verdict)
    assert set(np.flatnonzero(verdict.missing)) == set(np.flatnonzero(verdict.lost_in_transfer)) == set(lost)


@examples(times=2)
@given(st.integers(1, MAX_LIGHTS), st.fixed_dictionaries(clocks), st.data())
def test_one_missed_trigger_leaves_exactly_its_step_unproven(
    lights: int, clock: dict[str, float], data: st.DataObject
) -> None:
    burst = whole_burst(lights)
    step = data.draw(st.integers(0, len(burst.table) - 1))
    what = take(burst, missed=(step,), **clock)
    verdict = what.verdict()
    assert_all_proven(what, verdict)
    assert np.flatnonzero(verdict.missing).tolist() == [step]
    assert not verdict.lost_in_transfer.any()


@examples(times=2)
@given(st.integers(1, MAX_LIGHTS), st.floats(0, 20), st.floats(1, 100) | st.floats(500, 5_000), st.data())
def test_one_double_trigger_leaves_at_most_its_step_unproven(
    lights: int, jitter_us: float, after_us: float, data: st.DataObject
) -> None:
    burst = whole_burst(lights)
    step = data.draw(st.integers(0, len(burst.table) - 1))
    what = take(burst, surplus_us=(edge_us(burst, step) + 5.0 + after_us,), jitter_us=jitter_us)
    verdict = what.verdict()
    others = (what.truth >= 0) & (what.truth != step)
    assert np.array_equal(verdict.step_of_frame[others], what.truth[others])
    assert not verdict.missing.any()
    assert_no_wrong_label(what, verdict)


@pytest.mark.parametrize(
    "exposure_us",
    [10, pytest.param(500, marks=pytest.mark.full), 8_000, pytest.param(20_000, marks=pytest.mark.full), 300_000],
)
def test_every_wrong_alignment_of_a_clean_burst_leaves_too_many_frames_unexplained(exposure_us: int) -> None:
    """By brute force: lay the burst's edges on themselves, moved so that any frame falls on any wrong step."""
    tolerance_us = 2 * MODEL.jitter_us
    for lights in range(1, MAX_LIGHTS + 1):
        table = whole_burst(lights, exposure_us, lights % 3).table
        edges = np.concatenate([[0], np.cumsum(table["period_us"][:-1], dtype=np.int64)]).astype(np.float64)
        for frame, step in np.argwhere(~np.eye(len(edges), dtype=bool)):
            since = np.abs(edges - edges[frame])
            moved = edges + edges[step] - edges[frame]
            nearest = np.abs(moved[:, None] - edges[None, :]).min(axis=1)
            unexplained = int(np.sum(nearest > tolerance_us + MODEL.drift_ppm * 1e-6 * since))
            assert unexplained > MODEL.max_surplus, (lights, frame, step)

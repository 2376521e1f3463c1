"""Matching under one fault at a time: what is labelled, what is missing, what is known of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matching_takes import (
    END,
    GIGE,
    MODEL,
    START,
    Take,
    assert_all_proven,
    assert_no_wrong_label,
    edge_us,
    take,
    whole_burst,
)

from coupole.acquisition.clock_alignment import SURPLUS
from coupole.acquisition.frame_matching import UNLABELLED, _Aligned, _verdict
from coupole.devices import STEP_RECORD_DTYPE, UNKNOWN_NS

LIGHT = START + 2 + 3  # a step in the middle of the lights, behind two dark frames


def test_a_lost_transfer_leaves_its_step_missing_and_known_as_exposed() -> None:
    verdict = take(whole_burst(12), lost=(LIGHT,)).verdict()
    assert np.flatnonzero(verdict.missing).tolist() == [LIGHT]
    assert np.flatnonzero(verdict.lost_in_transfer).tolist() == [LIGHT]


def test_a_missed_trigger_leaves_its_step_missing_and_not_lost_in_transfer() -> None:
    verdict = take(whole_burst(12), missed=(LIGHT,)).verdict()
    assert np.flatnonzero(verdict.missing).tolist() == [LIGHT]
    assert not verdict.lost_in_transfer.any()


def test_a_run_of_lost_transfers_is_known_step_by_step() -> None:
    run = range(LIGHT, LIGHT + 5)
    verdict = take(whole_burst(12), lost=tuple(run)).verdict()
    assert np.flatnonzero(verdict.lost_in_transfer).tolist() == list(run)


def test_a_gap_of_one_lost_and_one_missed_frame_is_not_called_lost_in_transfer() -> None:
    verdict = take(whole_burst(12), lost=(LIGHT,), missed=(LIGHT + 1,)).verdict()
    assert np.flatnonzero(verdict.missing).tolist() == [LIGHT, LIGHT + 1]
    assert not verdict.lost_in_transfer.any()


def test_a_double_trigger_within_the_tolerance_labels_neither_frame_and_proves_all_others() -> None:
    burst = whole_burst(12)
    what = take(burst, surplus_us=(edge_us(burst, LIGHT) + 60.0,))
    verdict = what.verdict()
    unlabelled = np.flatnonzero(verdict.step_of_frame == UNLABELLED).tolist()
    assert unlabelled == [LIGHT, LIGHT + 1]
    assert verdict.ambiguous
    assert f"steps [{LIGHT}] have more than one frame each" in verdict.reason


def test_a_bounce_beyond_the_tolerance_is_surplus_and_the_step_is_proven() -> None:
    burst = whole_burst(12)
    what = take(burst, surplus_us=(edge_us(burst, LIGHT) + 3_000.0,))
    verdict = what.verdict()
    assert np.array_equal(verdict.step_of_frame, what.truth)
    assert np.flatnonzero(verdict.surplus).tolist() == [LIGHT + 1]
    assert not verdict.ambiguous


def test_more_surplus_frames_than_the_fault_model_allows_prove_nothing() -> None:
    burst = whole_burst(12)
    bounces = tuple(edge_us(burst, step) + 3_000.0 for step in range(LIGHT, LIGHT + MODEL.max_surplus + 1))
    verdict = take(burst, surplus_us=bounces).verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert verdict.ambiguous
    assert "every alignment of box and camera leaves more than 3 frames unexplained" in verdict.reason


def test_a_lost_first_frame_shifts_no_label() -> None:
    what = take(whole_burst(12), lost=(0,))
    assert_all_proven(what, what.verdict())


def test_a_lost_first_frame_and_a_surplus_last_one_shift_no_label() -> None:
    burst = whole_burst(12)
    last = len(burst.table) - 1
    what = take(burst, lost=(0,), surplus_us=(edge_us(burst, last) + burst.timing.period_us,))
    verdict = what.verdict()
    assert np.array_equal(verdict.step_of_frame, what.truth)
    assert np.flatnonzero(verdict.surplus).tolist() == [last]


def test_frame_ids_may_wrap_within_a_burst() -> None:
    what = take(whole_burst(12), lost=(LIGHT,), first_id=65535 - LIGHT, id_modulus=GIGE)
    verdict = what.verdict()
    assert what.frame_ids.min() == 1
    assert_all_proven(what, verdict)
    assert np.flatnonzero(verdict.lost_in_transfer).tolist() == [LIGHT]


def test_without_any_mark_equal_periods_are_declared_ambiguous_and_not_guessed() -> None:
    burst = whole_burst(12)
    steps = len(burst.table)
    verdict = take(burst, lost=(*range(START), *range(steps - END, steps))).verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert verdict.ambiguous
    assert "more than one alignment" in verdict.reason


def test_the_start_marks_alone_prove_a_burst() -> None:
    burst = whole_burst(12)
    steps = len(burst.table)
    what = take(burst, lost=tuple(range(steps - END, steps)))
    assert_all_proven(what, what.verdict())


def test_the_end_marks_alone_prove_a_burst() -> None:
    what = take(whole_burst(12), lost=tuple(range(START)))
    assert_all_proven(what, what.verdict())


@pytest.mark.parametrize("back", [0, 1])
def test_frame_ids_that_do_not_increase_prove_nothing(back: int) -> None:
    clean = take(whole_burst(12))
    ids = clean.frame_ids.copy()
    ids[LIGHT] = ids[LIGHT - 1] - back
    verdict = replace(clean, frame_ids=ids).verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert verdict.reason == "the camera's frame ids do not increase"


def test_timestamps_that_do_not_increase_prove_nothing() -> None:
    clean = take(whole_burst(12))
    stamps = clean.timestamps_ns.copy()
    stamps[LIGHT] = stamps[LIGHT - 1]
    verdict = replace(clean, timestamps_ns=stamps).verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert verdict.reason == "the camera's timestamps do not increase"


def test_a_frame_that_only_one_alignment_calls_surplus_is_not_thrown_away() -> None:
    log = np.zeros(2, STEP_RECORD_DTYPE)
    log["edge_sent"] = True
    said = _Aligned(np.arange(2), np.array([0, SURPLUS, 1]), np.array([True, False, True]))
    verdict = _verdict(log, np.array([0, 1, 2]), np.array([1, 1]), said)
    assert not verdict.surplus.any()
    assert verdict.ambiguous
    assert verdict.reason == "more than one alignment of box and camera is possible"


def test_without_frames_all_steps_are_missing_and_nothing_is_ambiguous() -> None:
    verdict = take(whole_burst(12)).verdict(frames=0)
    assert verdict.missing.all()
    assert not verdict.ambiguous


def test_frames_without_a_log_prove_nothing() -> None:
    verdict = take(whole_burst(12)).verdict(steps=0)
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert verdict.ambiguous
    assert verdict.reason == "frames came before the box sent an edge"


def test_a_step_that_sent_no_edge_is_neither_labelled_nor_missing() -> None:
    what = take(whole_burst(12), missed=(LIGHT,))
    what.log["edge_sent"][LIGHT] = False
    what.log["t_trigger_ns"][LIGHT] = UNKNOWN_NS
    verdict = what.verdict()
    assert_all_proven(what, verdict)
    assert not verdict.missing.any()


def test_the_first_frame_of_a_running_burst_is_not_labelled_before_the_log_can_say_whose_it_is() -> None:
    what = take(whole_burst(12), lost=(0,))
    verdict = what.verdict(complete=False, frames=1, steps=1)
    assert verdict.step_of_frame.tolist() == [UNLABELLED]


def test_surplus_frames_ahead_of_the_log_do_not_shift_the_labels_of_a_running_burst() -> None:
    burst = whole_burst(30)
    bounces = (edge_us(burst, 6) + 3_000.0, edge_us(burst, 16) + 3_000.0, edge_us(burst, 28) + 3_000.0)
    what = take(burst, missed=tuple(range(6)), surplus_us=bounces)
    frames = int(np.flatnonzero(what.truth == 29)[0]) + 1
    verdict = what.verdict(complete=False, frames=frames, steps=28)
    assert_no_wrong_label(what, verdict)


def test_frames_of_a_running_burst_are_proven_as_they_come() -> None:
    what = take(whole_burst(30))
    for frames in range(MODEL.max_surplus + MODEL.in_flight + START, len(what.truth) + 1):
        verdict = what.verdict(complete=False, frames=frames, steps=frames)
        assert np.array_equal(verdict.step_of_frame, what.truth[:frames])


def test_the_clock_fit_recovers_drift_and_offset() -> None:
    what = take(whole_burst(40, 1_500_000), relative_ppm=37.0, box_ppm=-20.0, jitter_us=20.0)
    clocks = what.verdict().clocks
    assert clocks is not None
    assert clocks.drift_ppm == pytest.approx(37.0, abs=1.0)
    box_ns = what.log["t_trigger_ns"].astype(np.float64)
    told_ns = clocks.offset_ns + (1 + clocks.drift_ppm * 1e-6) * box_ns
    assert np.allclose(told_ns, what.timestamps_ns, rtol=0, atol=40e3)
    assert 1.0 < clocks.residual_rms_us < 20.0
    assert clocks.residual_rms_us <= clocks.residual_max_us <= 40.0


# -- fixed cases at the edges of the tolerances -------------------------------------------------------------


@pytest.mark.parametrize("late_us", [250.0, 320.0, 390.0])
def test_nine_seconds_into_a_burst_a_late_frame_does_not_get_the_label_of_a_missing_one(late_us: float) -> None:
    """Drift alone would allow 900 us there; the clocks' line allows twice the jitter."""
    burst = whole_burst(12, 1_500_000)
    step = next(k for k in range(len(burst.table)) if edge_us(burst, k) > 9e6)
    what = take(
        burst, missed=(step,), surplus_us=(edge_us(burst, step) + late_us,), jitter_us=0.0, relative_ppm=0.0
    )
    verdict = what.verdict()
    labelled = verdict.step_of_frame
    assert labelled[step] == UNLABELLED
    assert_no_wrong_label(what, verdict)
    assert np.count_nonzero(labelled >= 0) > len(labelled) // 2


@pytest.mark.parametrize("after_us", [230.0, 300.0, 390.0])
def test_a_bounce_just_beyond_the_window_is_surplus_and_its_step_is_proven(after_us: float) -> None:
    burst = whole_burst(12)
    what = take(
        burst, surplus_us=(edge_us(burst, LIGHT) + 3.0 + after_us,), jitter_us=0.0, relative_ppm=0.0, box_ppm=0.0
    )
    verdict = what.verdict()
    assert np.array_equal(verdict.step_of_frame, what.truth)
    assert np.flatnonzero(verdict.surplus).tolist() == [LIGHT + 1]
    assert not verdict.ambiguous


@pytest.mark.parametrize("step", range(len(whole_burst(12).table)))
def test_a_double_edge_within_the_window_leaves_its_step_unproven_wherever_it_is(step: int) -> None:
    burst = whole_burst(12)
    what = take(burst, surplus_us=(edge_us(burst, step) + 50.0,), jitter_us=0.0, relative_ppm=0.0)
    verdict = what.verdict()
    assert np.flatnonzero(verdict.step_of_frame == UNLABELLED).tolist() == [step, step + 1]
    assert verdict.ambiguous


def test_four_double_edges_within_the_window_prove_nothing() -> None:
    """One more than the fault model allows, though each of them lies on a step."""
    burst = whole_burst(12)
    doubles = tuple(edge_us(burst, step) + 50.0 for step in range(LIGHT, LIGHT + MODEL.max_surplus + 1))
    verdict = take(burst, surplus_us=doubles, jitter_us=0.0, relative_ppm=0.0).verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert "leaves more than 3 frames unexplained" in verdict.reason


def test_as_many_surplus_frames_before_a_burst_as_are_allowed_hide_no_label() -> None:
    """The true alignment then has its first anchor at the fourth frame."""
    what = take(
        whole_burst(12),
        surplus_us=(-51_234.0, -30_777.0, -11_111.0),
        jitter_us=0.0,
        relative_ppm=0.0,
    )
    verdict = what.verdict()
    assert what.truth[:4].tolist() == [-1, -1, -1, 0]
    assert np.array_equal(verdict.step_of_frame, what.truth)
    assert np.flatnonzero(verdict.surplus).tolist() == [0, 1, 2]
    assert not verdict.ambiguous


def test_no_more_frames_than_may_be_surplus_prove_nothing() -> None:
    what = take(whole_burst(12), missed=tuple(range(3, len(whole_burst(12).table))))
    assert len(what.truth) == MODEL.max_surplus
    verdict = what.verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert "too few frames" in verdict.reason


def with_two_steps_more(gap_s: float) -> Take:
    """A clean burst, then a gap, then two steps 20 ms apart, of which the second has a frame."""
    before, apart_ns, gap_ns = take(whole_burst(12), jitter_us=0.0, relative_ppm=0.0), 20_000_000, int(gap_s * 1e9)
    log = np.concatenate([before.log, before.log[-2:]])
    log["t_trigger_ns"][-2:] = before.log["t_trigger_ns"][-1] + gap_ns + np.array([0, apart_ns])
    stamps = np.append(before.timestamps_ns, before.timestamps_ns[-1] + gap_ns + apart_ns)
    return replace(before, log=log, frame_ids=np.arange(len(stamps)), timestamps_ns=stamps)


def test_a_gap_in_which_the_clocks_may_drift_by_a_step_proves_nothing() -> None:
    """100 ppm of 250 s are 25 ms."""
    verdict = with_two_steps_more(250.0).verdict()
    assert np.all(verdict.step_of_frame == UNLABELLED)
    assert "drift makes it uncertain which step comes next" in verdict.reason


def test_half_that_gap_hides_nothing() -> None:
    what = with_two_steps_more(125.0)
    verdict = what.verdict()
    assert verdict.step_of_frame[-1] == len(what.log) - 1
    assert not verdict.ambiguous

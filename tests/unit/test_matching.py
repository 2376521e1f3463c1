"""Matching: no frame ever gets a wrong label, whatever is lost or added within the fault model.

A *take* is what really happened in one burst: the real table of a schedule, run by a box with its own clock,
seen by a camera with another clock, with frames lost and frames added. `match` is told the log, the ids and the
timestamps only; the take knows the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.devices import STATUS_NO_EDGE, STEP_RECORD_DTYPE
from coupole.dome import LedTable
from coupole.matching import UNLABELLED, FaultModel, Match, match
from coupole.plan import Plan
from coupole.shots import END_MARK_EXTRA, START_MARK_EXTRA, Burst, build_schedule

MODEL = FaultModel()
START, END = len(START_MARK_EXTRA), len(END_MARK_EXTRA)
GIGE = (1, 65535)
PLAIN = (0, 2**62)
EXPOSURES_US = (500, 8_000, 40_000, 1_500_000)
MAX_LIGHTS = 40


@lru_cache
def whole_burst(lights: int, exposure_us: int = 8_000, darks: int = 2) -> Burst:
    """The burst of one view of a small dome, 6 LEDs on a board, a camera of 100 frames/s."""
    index = np.arange(lights)
    leds = LedTable(
        index, index // 6, np.full((lights, 3), 1e3), np.full((lights, 3), -1 / 3**0.5), np.ones(lights)
    )
    plan = Plan.model_validate(
        {
            "schema_version": 1,
            "name": "small",
            "rig": "rig.yaml",
            "views": [{"kind": "joints", "name": "v", "joints_deg": [0, -90, 90, 0, 90, 0]}],
            "lights": {"kind": "all"},
            "exposure": {"kind": "fixed", "exposure_us": exposure_us},
            "darks_per_view": darks,
        }
    )
    schedule = build_schedule(plan, leds, np.eye(4), rise_us=1000, readout_us=10_000.0, exposure_gap_us=100)
    return schedule.bursts[0][0]


def edge_us(burst: Burst, step: int) -> float:
    """Nominal time of a step's edge, from the first edge on."""
    return float(np.sum(burst.table["period_us"][:step]))


@dataclass(frozen=True)
class Take:
    """One burst as it happened. Frames are in the order of their exposure."""

    log: NDArray[np.void]
    frame_ids: NDArray[np.int64]
    timestamps_ns: NDArray[np.int64]
    truth: NDArray[np.int64]
    """[frames] the step that fired the frame, -1 for a surplus one."""
    edges_us: NDArray[np.float64]
    """[steps] true time of each edge."""
    frames_us: NDArray[np.float64]
    """[frames] true time of each exposure."""
    exposed: NDArray[np.bool_]
    """[steps] the camera exposed a frame (and counted an id), whether or not it arrived."""
    id_modulus: tuple[int, int]
    jitter_us: float

    def verdict(self, *, complete: bool = True, frames: int | None = None, steps: int | None = None) -> Match:
        return match(
            self.log[:steps],
            self.frame_ids[:frames],
            self.timestamps_ns[:frames],
            id_modulus=self.id_modulus,
            complete=complete,
            model=MODEL,
        )


def reach_us(edges_us: NDArray[np.float64]) -> float:
    """How near to an edge a frame must come to be taken for the edge's own, at most."""
    return 6 * MODEL.jitter_us + MODEL.drift_ppm * 1e-6 * float(edges_us[-1] - edges_us[0])


def take(
    burst: Burst,
    *,
    lost: tuple[int, ...] | NDArray[np.int64] = (),
    missed: tuple[int, ...] | NDArray[np.int64] = (),
    surplus_us: tuple[float, ...] = (),
    box_ppm: float = 40.0,
    relative_ppm: float = -80.0,
    jitter_us: float = 20.0,
    first_id: int = 1,
    id_modulus: tuple[int, int] = PLAIN,
    dead_us: float = 0.0,
    seed: int = 0,
) -> Take:
    """Run a burst: `lost` steps' frames are lost in transfer, `missed` steps' edges are not seen by the camera.

    `surplus_us` are true times, from the first edge on, of frames that no step fired. An edge that comes within
    `dead_us` of the last one that made a frame is ignored.
    """
    rng = np.random.default_rng(seed)
    table = burst.table
    steps = len(table)
    on_us = np.concatenate([[0], np.cumsum(table["period_us"][:-1], dtype=np.int64)]).astype(np.float64)
    edges_us = on_us + table["trigger_delay_us"] + rng.uniform(0.0, 3.0, steps)
    edges_us -= table["trigger_delay_us"][0]
    box_rate = 1 + box_ppm * 1e-6
    camera_rate = box_rate * (1 + relative_ppm * 1e-6)

    log = np.zeros(steps, STEP_RECORD_DTYPE)
    log["step"], log["led"] = np.arange(steps), table["led"]
    log["t_on_ns"] = 7_000_000_000_123 + on_us * 1e3 * box_rate
    log["t_trigger_ns"] = 7_000_000_000_123 + edges_us * 1e3 * box_rate

    exposed = np.ones(steps, np.bool_)
    exposed[np.asarray(missed, np.int64)] = False
    fired = np.flatnonzero(exposed)
    times_us = np.concatenate([edges_us[fired], np.asarray(surplus_us, np.float64)])
    origin = np.concatenate([fired, np.full(len(surplus_us), -1)])
    order = np.argsort(times_us, kind="stable")
    times_us, origin = times_us[order], origin[order]
    ready_us = -np.inf
    heard = np.ones(len(times_us), np.bool_)
    for event, time_us in enumerate(times_us):
        heard[event] = time_us >= ready_us
        ready_us = time_us + dead_us if heard[event] else ready_us
    exposed[origin[~heard & (origin >= 0)]] = False
    times_us, origin = times_us[heard], origin[heard]
    arrives = np.concatenate([exposed, [True]])  # surplus frames, at -1, arrive
    arrives[np.asarray(lost, np.int64)] = False
    here = arrives[origin]
    first, last = id_modulus
    ids = first + (first_id - first + np.arange(len(times_us))) % (last - first + 1)
    stamps = 3_600e9 + times_us * 1e3 * camera_rate + rng.uniform(-1, 1, len(times_us)) * jitter_us * 1e3
    stamps_ns = stamps.astype(np.int64)[here]
    rise = np.arange(len(stamps_ns))  # a camera's clock never steps back: keep the stamps apart by 1 ns at least
    stamps_ns = np.maximum.accumulate(stamps_ns - rise) + rise
    return Take(
        log,
        ids[here],
        stamps_ns,
        origin[here],
        edges_us,
        times_us[here],
        exposed,
        id_modulus,
        jitter_us,
    )


@st.composite
def bursts(draw: st.DrawFn) -> Burst:
    """Tables of the schedule, whole or with a few shots only, as after a first round of losses."""
    burst = whole_burst(
        draw(st.integers(1, MAX_LIGHTS)), draw(st.sampled_from(EXPOSURES_US)), draw(st.integers(0, 2))
    )
    match draw(st.sampled_from(("whole", "whole", "some", "one"))):
        case "whole":
            return burst
        case "one":
            inner = burst.labels[START:-END]
            return burst.only({draw(st.sampled_from(inner))})
    keep = np.random.default_rng(draw(st.integers(0, 2**32))).random(len(burst.labels)) < draw(st.floats(0.1, 0.9))
    return burst.only({label for label, kept in zip(burst.labels, keep, strict=True) if kept})


@st.composite
def gone(draw: st.DrawFn, steps: int) -> NDArray[np.int64]:
    """Steps without a frame: none, single ones, a run, the first, the last, the marks, most of the burst."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    gone = np.zeros(steps, np.bool_)
    for pattern in draw(
        st.lists(st.sampled_from(("few", "run", "first", "last", "start marks", "end marks", "most")), max_size=3)
    ):
        match pattern:
            case "few":
                gone[rng.integers(0, steps, rng.integers(1, 4))] = True
            case "run":
                start = rng.integers(0, steps)
                gone[start : start + rng.integers(1, steps)] = True
            case "first":
                gone[: rng.integers(1, START + 3)] = True
            case "last":
                gone[steps - rng.integers(1, END + 3) :] = True
            case "start marks":
                gone[:START] = True
            case "end marks":
                gone[-END:] = True
            case "most":
                gone |= rng.random(steps) < rng.uniform(0.5, 0.98)
    return np.flatnonzero(gone)


@st.composite
def added(draw: st.DrawFn, burst: Burst, most: int = MODEL.max_surplus) -> tuple[float, ...]:
    """True times, in us from the first edge on, of frames that no step fired."""
    edges_us = np.concatenate([[0], np.cumsum(burst.table["period_us"][:-1], dtype=np.int64)])
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    times_us = []
    kinds = st.sampled_from(("bounce", "on an edge", "between", "before", "after", "in step"))
    for kind in draw(st.lists(kinds, max_size=most)):
        edge = edges_us[rng.integers(0, len(edges_us))]
        match kind:
            case "bounce":
                times_us.append(edge + rng.uniform(1, 5_000))
            case "on an edge":
                times_us.append(edge + rng.uniform(-400, 400))
            case "between":
                times_us.append(rng.uniform(0, edges_us[-1]))
            case "before":
                times_us.append(-rng.uniform(1, 1e6))
            case "after":
                times_us.append(edges_us[-1] + rng.uniform(1, 1e6))
            case "in step":  # where one more ordinary step would be: the most misleading place
                side = rng.choice([0, -1])
                away = burst.timing.period_us * rng.integers(1, 4) * (1 if side else -1)
                times_us.append(edges_us[side] + away + rng.uniform(-50, 50))
    return tuple(map(float, times_us))


@st.composite
def takes(draw: st.DrawFn) -> Take:
    """What the fault model allows, several faults at once."""
    burst = draw(bursts())
    steps = len(burst.table)
    lost = draw(gone(steps))
    missed = draw(gone(steps)) if draw(st.booleans()) else np.zeros(0, np.int64)
    return take(
        burst,
        lost=lost,
        missed=missed,
        surplus_us=draw(added(burst)),
        box_ppm=draw(st.floats(-60, 60)),
        relative_ppm=draw(st.floats(-99, 99)),
        jitter_us=draw(st.floats(0, MODEL.jitter_us)),
        first_id=draw(st.one_of(st.integers(1, 5), st.integers(65_480, 65_535), st.integers(1, 65_535))),
        id_modulus=draw(st.sampled_from((PLAIN, GIGE))),
        dead_us=burst.timing.exposure_us,
        seed=draw(st.integers(0, 2**32)),
    )


def examples(count: int) -> settings:
    return settings(deadline=None, max_examples=count, suppress_health_check=[HealthCheck.too_slow])


def assert_no_wrong_label(what: Take, verdict: Match) -> None:
    """A surplus frame may have a label only if it started so near to an edge whose own frame is not here that it
    cannot be told from it: it shows that step's light."""
    for frame in np.flatnonzero(verdict.step_of_frame >= 0):
        step, truth = verdict.step_of_frame[frame], what.truth[frame]
        if truth < 0:
            assert abs(what.frames_us[frame] - what.edges_us[step]) <= reach_us(what.edges_us)
            assert step not in what.truth[: len(verdict.step_of_frame)]
        else:
            assert step == truth


# ------------------------------------------------------------------------------------------------ never wrong


@examples(4000)
@given(takes())
def test_no_frame_of_a_finished_burst_gets_a_wrong_label(what: Take) -> None:
    assert_no_wrong_label(what, what.verdict())


@examples(2000)
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


@examples(800)
@given(takes())
def test_a_step_is_called_missing_only_if_no_frame_of_it_is_here(what: Take) -> None:
    here = np.zeros(len(what.log), np.bool_)
    here[what.truth[what.truth >= 0]] = True
    assert not np.any(what.verdict().missing & here)


@examples(800)
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


# ------------------------------------------------------------------------------------------- proves what it can


def assert_all_proven(what: Take, verdict: Match) -> None:
    assert np.array_equal(verdict.step_of_frame, what.truth)
    assert not verdict.ambiguous
    assert not verdict.reason
    assert not verdict.surplus.any()


clocks = {
    "box_ppm": st.floats(-60, 60),
    "relative_ppm": st.floats(-99, 99),
    "jitter_us": st.floats(0, MODEL.jitter_us),
    "seed": st.integers(0, 2**32),
}


@examples(500)
@given(bursts(), st.fixed_dictionaries(clocks))
def test_a_clean_burst_is_proven_completely(burst: Burst, clock: dict[str, float]) -> None:
    what = take(burst, **clock)
    verdict = what.verdict()
    assert_all_proven(what, verdict)
    assert not verdict.missing.any()


@examples(500)
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


@examples(300)
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


@examples(300)
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


# --------------------------------------------------------------------------------------------- one fault at a time

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
    assert "no alignment of box and camera leaves 3 frames or fewer unexplained" in verdict.reason


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


def test_frame_ids_that_do_not_increase_prove_nothing() -> None:
    clean = take(whole_burst(12))
    ids = clean.frame_ids.copy()
    ids[LIGHT] = ids[LIGHT - 1]
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
    what.log["status"][LIGHT] = STATUS_NO_EDGE
    what.log["t_trigger_ns"][LIGHT] = 0
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


# ----------------------------------------------------------------------------------------------- the code of marks


@pytest.mark.parametrize("exposure_us", [10, 500, 8_000, 20_000, 300_000])
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

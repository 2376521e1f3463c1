"""Takes of bursts, drawn at random: for the tests of matching.

A *take* is what really happened in one burst: the real table of a schedule, run by a box with its own clock,
seen by a camera with another clock, with frames lost and frames added. `match` is told the log, the ids and the
timestamps only; the take knows the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.acquisition.frame_matching import FaultModel, Match, match
from coupole.devices import STEP_RECORD_DTYPE
from coupole.plan.bursts import Burst, DeviceTimes
from coupole.plan.led_table import LedTable
from coupole.plan.marks import END_MARK_EXTRA, START_MARK_EXTRA
from coupole.plan.plan import Plan
from coupole.plan.schedule import build_schedule

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
    schedule = build_schedule(plan, leds, np.eye(4), DeviceTimes(1000, 10_000.0, 100))
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
    log["step"], log["led"], log["edge_sent"] = np.arange(steps), table["led"], True
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


def examples(times: int) -> settings:
    """So many times as many as other properties get."""
    count = times * settings().max_examples
    return settings(max_examples=count, suppress_health_check=[HealthCheck.too_slow])


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


def assert_all_proven(what: Take, verdict: Match) -> None:
    assert np.array_equal(verdict.step_of_frame, what.truth)
    assert not verdict.ambiguous
    assert not verdict.reason
    assert not verdict.surplus.any()

"""Runs whose LEDs are chosen while they run: within what preflight has checked, the same over a kill, fewer errors
between them than as many LEDs that are merely spread."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import SIDE, TOP, CellFolder
from in_part import in_part
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from coupole.acquisition.frame_samples import frame_sample
from coupole.plan.choices import Choice, FrameSample, next_choice, refuse_beyond
from coupole.plan.shot_id import ShotLabel
from coupole.preflight.adaptive_lights import AdaptiveLightsChooser
from coupole.preflight.choosers import chooser_of
from coupole.preflight.job import read_job, without_hidden
from coupole.storage.run import Run
from coupole.storage.verification import verify

AMONG = {"kind": "every", "every": 5}
"""216 LEDs."""
ADAPTIVE = {
    "kind": "adaptive",
    "among": AMONG,
    "first_lights": 16,
    "burst_lights": 16,
    "until": {"lights": 60},
}


def _cell(folder: Path, speed: float = 5.0, **lights: Any) -> CellFolder:
    cell = CellFolder(folder, speed=speed)
    cell.write(views=[TOP, SIDE], lights=ADAPTIVE | lights)
    return cell


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    """A run that nobody disturbed."""
    cell = _cell(tmp_path_factory.mktemp("whole"))
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    return cell


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    """A run of the first view with all LEDs from which is chosen."""
    cell = CellFolder(tmp_path_factory.mktemp("every"), speed=5.0)
    cell.write(views=[TOP], lights=AMONG)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    return cell


def _leds(choices: list[Choice]) -> list[int]:
    return [led for choice in choices for burst in choice.bursts for led in burst.leds]


def test_each_view_gets_as_many_leds_as_the_plan_allows_each_once(whole: CellFolder) -> None:
    for choices in Run(whole.run_folder).choices().values():
        leds = _leds(list(choices))
        assert len(leds) == len(set(leds)) == 60
        assert [len(burst.leds) for choice in choices for burst in choice.bursts] == [16, 16, 16, 12]
        assert choices[-1].bursts == ()
        assert choices[-1].reason.startswith("enough by `lights`: 60 LEDs are lit")
        errors = [choice.figures["relit_rms"] for choice in choices[1:]]
        assert errors[-1] < errors[0]


def test_a_run_costs_no_more_than_preflight_says_and_is_verified(whole: CellFolder) -> None:
    allowed = cells.here("check", whole.plan, "--json").document
    status = cells.here("status", whole.run_folder, "--json").document
    assert 0 < status["dose_lux_h"] <= allowed["dose_lux_h"]
    assert allowed["shots"] == 120
    assert cells.here("verify", whole.run_folder).code == 0


def test_light_is_bounded_by_the_brightest_leds_not_by_all(whole: CellFolder, tmp_path: Path) -> None:
    of_all = _cell(tmp_path, until={"lights": 216})
    some, every_led = (cells.here("check", cell.plan, "--json").document["dose_lux_h"] for cell in (whole, of_all))
    assert 60 / 216 <= some / every_led < 1.5 * 60 / 216


def test_from_the_third_burst_on_leds_are_chosen_from_the_frames_before_the_last(whole: CellFolder) -> None:
    for choices in Run(whole.run_folder).choices().values():
        figures = [choice.figures for choice in choices[1:]]
        assert [(each["seen"], each["lights"]) for each in figures] == [(16, 16), (16, 32), (32, 48), (60, 60)]


def test_leds_are_chosen_while_the_burst_before_them_is_fired(tmp_path: Path) -> None:
    cell = _cell(tmp_path, speed=1.0, burst_lights=64, until={"lights": 208})
    cell.write(views=[TOP])
    assert cell.acquire().code == 0
    order = [
        line["event"] for line in cells.events(cell.run_folder) if line["event"] in ("begin", "chosen", "burst")
    ]
    assert order.count("begin") == order.count("burst") == 4
    assert order[:6] == ["chosen", "begin", "burst", "chosen", "begin", "chosen"], order


def _rms_between(frames: dict[str, cells.Stored], job: Any, leds: list[int]) -> float:
    """Error of pictures made by scipy for the LEDs that were not lit, DN."""
    target_mm = np.array([0.0, 0.0, 30.0]) + job.cell.rig.support.base_from_support.matrix()[:3, 3]
    ways = job.cell.leds.positions_mm - target_mm
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    pictures: dict[int, NDArray[np.float64]] = {
        int(frame.record["led"]): frame.pixels[::2, ::2].astype(float).ravel()
        for shot, frame in frames.items()
        if cells.is_light(shot)
    }
    others = sorted(set(pictures) - set(leds))
    rows = job.cell.leds.rows
    values = np.stack([pictures[led] for led in leds])
    made = RBFInterpolator(ways[rows(leds)], values, kernel="linear", degree=1)(ways[rows(others)])
    return float(np.sqrt(np.mean((made - np.stack([pictures[led] for led in others])) ** 2)))


def test_pictures_between_are_better_than_with_as_many_spread_leds(whole: CellFolder, every: CellFolder) -> None:
    frames, job = cells.stored(every.run_folder), read_job(every.plan)
    choices = list(Run(whole.run_folder).choices()["top"])
    chosen = _rms_between(frames, job, _leds(choices))
    spread = _rms_between(frames, job, np.sort(job.cell.leds.ids)[::5][:: 216 // 60][:60].tolist())
    assert chosen < 1.05 * spread
    bright = np.quantile([f.pixels.max() for s, f in frames.items() if cells.is_light(s)], 0.999) - cells.BLACK_DN
    assert 0.5 < choices[-1].figures["relit_rms"] / (chosen / bright) < 2.0


def _chosen_anew(cell: CellFolder, run: Path) -> dict[str, list[Any]]:
    """What follows from the frames that are on the disk, choice by choice."""
    job, opened = without_hidden(read_job(cell.plan)), Run(run)
    chooser, stored, chosen = chooser_of(job), cells.stored(run), {}
    assert chooser is not None
    made = opened.choices()
    for number, pose in enumerate(job.schedule.views):
        view, known = job.schedule.open_view(number), made[pose.name]
        samples: dict[ShotLabel, FrameSample] = {}
        for place, choice in enumerate(known):
            anew = view.with_darks(known[:place], next_choice(chooser, view, tuple(known[:place]), dict(samples)))
            chosen.setdefault(pose.name, []).append(anew)
            for label in (label for burst in choice.bursts for label in burst.labels()):
                samples[label] = frame_sample(stored[f"{pose.name}/{label}"].pixels, cells.BLACK_DN, 4095)
    return chosen


def test_choices_follow_from_the_frames(whole: CellFolder) -> None:
    assert _chosen_anew(whole, whole.run_folder) == Run(whole.run_folder).choices()


@pytest.mark.parametrize("frames", in_part([30, 3, 75], 30))
def test_a_killed_run_goes_on_as_its_frames_ask(tmp_path: Path, frames: int) -> None:
    cell = _cell(tmp_path, speed=2.0)
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) >= frames, "proven frames")
    process.kill()
    cells.finish(process)
    before = Run(run).choices()
    ended = cell.acquire("--resume", run)
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0
    chosen = Run(run).choices()
    assert all(chosen[view][: len(made)] == made for view, made in before.items())
    assert chosen == _chosen_anew(cell, run)
    assert verify(Run(run)).ok


def test_it_stops_when_the_expected_error_is_small_enough(tmp_path: Path) -> None:
    cell = _cell(tmp_path, until={"lights": 60, "relit_rms": 0.5})
    assert cell.acquire().code == 0
    for choices in Run(cell.run_folder).choices().values():
        assert len(_leds(list(choices))) == 16
        assert choices[-1].reason.startswith("enough by `relit_rms`")


@pytest.mark.parametrize(
    ("until", "lights"), in_part([({"seconds": 0.6}, 40), ({"lux_h": 0.02}, 40)], ({"lux_h": 0.02}, 40))
)
def test_it_stops_before_time_or_light_are_exceeded(tmp_path: Path, until: dict[str, float], lights: int) -> None:
    cell = _cell(tmp_path, until={"lights": 60, **until})
    cell.write(views=[TOP])
    assert cell.acquire().code == 0
    choices = list(Run(cell.run_folder).choices()["top"])
    assert 0 < len(_leds(choices)) < lights
    assert "`seconds` or `lux_h`" in choices[-1].reason
    job = read_job(cell.plan)
    view = job.schedule.open_view(0)
    bursts = [view.burst_of(burst) for choice in choices for burst in choice.bursts]
    if "seconds" in until:
        assert sum(burst.duration_s for burst in bursts) <= until["seconds"]
    else:
        assert cells.here("status", cell.run_folder, "--json").document["dose_lux_h"] <= 1.2 * until["lux_h"]


def test_a_view_of_the_same_plan_may_have_lights_of_its_own(tmp_path: Path) -> None:
    cell = _cell(tmp_path)
    cell.write(views=[TOP, {**SIDE, "lights": {"kind": "ids", "ids": [3, 500, 77]}}])
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["shots"] == 63
    assert verify(Run(cell.run_folder)).ok


def test_hidden_leds_are_not_chosen_and_others_take_their_place(tmp_path: Path) -> None:
    cell = _cell(tmp_path)
    job = read_job(cell.plan)
    of_view = job.schedule.without({"top": job.schedule.open_view(0).leds[:40].tolist()}).open_view(0)
    assert len(of_view.leds) == 176
    assert sum(int(burst.is_light().sum()) for burst in of_view.bound) == 60


def test_leds_that_arm_and_object_hide_are_not_chosen_though_they_are_only_marked(tmp_path: Path) -> None:
    cell = _cell(tmp_path, among={"kind": "all"})
    cell.write(views=[{**TOP, "name": "steep", "elevation_deg": 88}], hidden_lights="mark")
    job = without_hidden(read_job(cell.plan))
    hidden_leds = job.hidden_leds["steep"]
    assert not set(hidden_leds) & set(job.schedule.open_view(0).leds.tolist())
    cell.write(lights={**ADAPTIVE, "among": {"kind": "ids", "ids": list(hidden_leds)}})
    refused = cells.here("check", cell.plan)
    assert refused.code == 2
    assert "arm and object hide all LEDs" in refused.err


@pytest.mark.parametrize("until", [{"seconds": 0.001}, {"lux_h": 1e-9}])
def test_a_limit_that_allows_no_led_is_refused(tmp_path: Path, until: dict[str, float]) -> None:
    refused = _cell(tmp_path, until={"lights": 60, **until}).acquire()
    assert refused.code == 3
    assert "do not allow a single LED" in refused.out + refused.err


def test_fewer_leds_than_errors_can_be_told_from_are_all_lit(tmp_path: Path) -> None:
    cell = _cell(tmp_path, among={"kind": "ids", "ids": [3, 500, 77]})
    cell.write(views=[TOP])
    assert cell.acquire().code == 0
    choices = Run(cell.run_folder).choices()["top"]
    assert _leds(list(choices)) == [3, 77, 500]
    assert choices[-1].reason == "all LEDs of the view are lit"


@pytest.mark.parametrize("change", [{"exposure_us": 2_000_000}, {"leds": [5000]}, {"leds": [1, 2]}])
def test_a_changed_choice_is_not_gone_on_with(whole: CellFolder, tmp_path: Path, change: dict[str, Any]) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run_folder, run)
    journal = run / "journal.jsonl"
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    next(line for line in lines if line["event"] == "chosen")["bursts"][0].update(change)
    journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    ended = whole.acquire("--resume", run)
    assert ended.code == 6
    assert "a choice that its plan does not allow" in ended.err


@pytest.mark.parametrize("model", in_part(["kuka", "ur10e"], "kuka"))
def test_a_choice_that_takes_seconds_leaves_all_dark_and_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    """Longer than the box's watchdog, and than an arm in motion may be without news."""
    cell = _cell(tmp_path, speed=1.0, until={"lights": 48})
    if model != "kuka":
        cell.moved_by_ur(model)
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = 2.0
    cell.write(views=[TOP])
    choose = AdaptiveLightsChooser._next  # not of the first burst, which is chosen before the arm moves

    def think(chooser: AdaptiveLightsChooser, *arguments: Any, **named: Any) -> Choice:
        time.sleep(4.0)
        return choose(chooser, *arguments, **named)

    monkeypatch.setattr(AdaptiveLightsChooser, "_next", think)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] == 0
    assert verify(Run(cell.run_folder)).ok
    bursts = cells.events(cell.run_folder, "burst")
    lit_s = 48 * 0.02
    assert sum(burst["on_s"] for burst in bursts) < lit_s, "no lamp stays on while it thinks"


def test_what_a_plan_may_cost_is_said_to_be_the_most(whole: CellFolder) -> None:
    checked = cells.here("check", whole.plan)
    said = " ".join((checked.out + checked.err).split())
    assert "light on the object, at most" in said
    assert "duration, at most" in said


def test_more_than_the_bound_is_never_fired(tmp_path: Path) -> None:
    view = read_job(_cell(tmp_path).plan).schedule.open_view(0)
    whole = view.burst(0)
    refuse_beyond(view.bound, [whole.only({label for label in whole.labels[:60] if label})])
    with pytest.raises(RuntimeError, match="where preflight has checked"):
        refuse_beyond(view.bound, [whole])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exposure": {"kind": "bracket", "exposures_us": [2000, 8000]}}, "`exposure: {kind: fixed}`"),
        ({"repeats": 2}, "`repeats: 1`"),
        ({"views": [TOP, {**SIDE, "lights": {"kind": "panels"}}]}, "panels or dark frames alone are not allowed"),
        ({"lights": {**ADAPTIVE, "until": {"lights": 5}}}, "lights"),
        ({"lights": {**ADAPTIVE, "until": {"lights": 1000}, "burst_lights": 1}}, "at most 128 bursts"),
        ({"lights": {**ADAPTIVE, "among": {"kind": "ids", "ids": [4000]}}}, "no LED 4000"),
        ({"lights": {"kind": "adaptive"}}, "until"),
    ],
)
def test_what_cannot_be_chosen_is_refused_at_its_place(tmp_path: Path, change: Any, message: str) -> None:
    cell = _cell(tmp_path)
    cell.write(**change)
    refused = cells.here("check", cell.plan)
    assert refused.code == 2
    assert message in refused.out + refused.err
    assert "plan.yaml:" in refused.out + refused.err

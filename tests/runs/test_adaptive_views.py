"""Runs whose views are chosen while they run: as preflight bounds them, with reasons, the same over a kill."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import CellFolder
from in_part import in_part

import coupole
from coupole.console.runs.run_files import RunFiles
from coupole.console.runs.run_watch import RunWatch
from coupole.plan.view_choices import ChosenView
from coupole.preflight.job import read_job, without_hidden
from coupole.preflight.preflight import CHOICE_S
from coupole.reflectance.next_views.next_views import NextViews
from coupole.storage.run import Run
from coupole.storage.verification import verify

RING = {
    "kind": "grid",
    "name": "ring",
    "target_mm": [0, 0, 30],
    "distance_mm": 335,
    "azimuths_deg": [-150, -90, -30],
    "elevations_deg": [50, 80],
}
"""Six views."""
FEW_LIGHTS = {"kind": "every", "every": 90}
"""12 LEDs."""
ADAPTIVE_LIGHTS = {
    "kind": "adaptive",
    "among": {"kind": "every", "every": 20},
    "first_lights": 8,
    "burst_lights": 8,
    "until": {"lights": 16},
}


def _cell(folder: Path, speed: float = 5.0, **until: Any) -> CellFolder:
    cell = CellFolder(folder, speed=speed)
    views = {"kind": "adaptive", "candidates": [RING], "until": {"views": 3} | until}
    cell.write(views=views, lights=FEW_LIGHTS)
    return cell


def _status(run: Path) -> dict[str, Any]:
    document: dict[str, Any] = cells.here("status", run, "--json").document
    return document


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    """A run that nobody disturbed."""
    cell = _cell(tmp_path_factory.mktemp("whole"))
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0
    return cell


def _chosen_anew(cell: CellFolder, run: Path) -> list[ChosenView]:
    """What follows from the plan alone, choice by choice."""
    job = without_hidden(read_job(cell.plan))
    next_views, known = NextViews(job, job.plan.views.until), Run(run).chosen_views()
    return [next_views.choose(known[:place], job.schedule) for place in range(len(known))]


def test_as_many_views_are_taken_as_the_plan_allows_and_all_their_frames(whole: CellFolder) -> None:
    run = Run(whole.run_folder)
    chosen_views = run.chosen_views()
    assert len(run.views) == len(set(run.views)) == 3
    assert [chosen.view for chosen in chosen_views] == [*run.views, ""]
    assert chosen_views[-1].reason.startswith("enough by `views`: 3 views")
    assert sorted(path.stem for path in (run.folder / "views").glob("*.h5")) == sorted(run.views)
    assert len(run.about["views"]) == 6
    assert verify(run).ok
    assert {shot.view for shot in run.proven()} == set(run.views)
    moves = [event["view"] for event in cells.events(run.folder, "move")]
    assert moves == run.views


def test_each_choice_has_its_reason_and_the_next_best(whole: CellFolder) -> None:
    *chosen_views, last = Run(whole.run_folder).chosen_views()
    for place, chosen in enumerate(chosen_views):
        assert "lowers the expected uncertainty by" in chosen.reason
        figures = chosen.figures
        assert figures["views"] == place
        assert len(figures["next_best"]) == min(5, 5 - place)
        best_other = max(other["score"] for other in figures["next_best"])
        assert figures["chosen"]["score"] >= 0.979 * best_other
        earlier = {one.view for one in chosen_views[: place + 1]}
        assert not earlier & {other["view"] for other in figures["next_best"]}
    coverages = [chosen.figures["coverage"] for chosen in (*chosen_views, last)]
    assert coverages == sorted(coverages)
    assert coverages[-1] > 0.5
    gains = [chosen.figures["chosen"]["gain"] for chosen in chosen_views]
    assert min(gains) > 0  # they may grow: a part with few samples counts by its share


def test_a_run_costs_no_more_than_preflight_and_the_choices_say(whole: CellFolder) -> None:
    allowed = cells.here("check", whole.plan, "--json").document
    assert (allowed["views"], allowed["candidates"]) == (3, 6)
    status = _status(whole.run_folder)
    last = Run(whole.run_folder).chosen_views()[-1]
    assert 0 < status["dose_lux_h"] <= 1.0001 * last.figures["lux_h"] <= 1.0002 * allowed["dose_lux_h"]
    assert last.figures["seconds"] <= allowed["duration_s"]
    assert last.figures["frames"] == allowed["frames"] == len(list(Run(whole.run_folder).expected_shots()))
    assert allowed["shots"] == 36
    checked = cells.here("check", whole.plan)
    said = checked.out + checked.err
    assert "6 candidates" in said
    assert "views, shots, frames, at most" in said


def test_status_and_report_say_how_many_and_why(whole: CellFolder) -> None:
    status = _status(whole.run_folder)
    assert (status["state"], status["most_views"], status["wants_views"]) == ("done", 3, False)
    assert set(status["views"]) == set(Run(whole.run_folder).views)
    assert status["why_enough_views"].startswith("enough by `views`")
    shown = cells.here("status", whole.run_folder)
    said = " ".join((shown.out + shown.err).split())
    assert "chosen in the run: 3 of at most 3 views; enough by `views`" in said
    report = (whole.run_folder / "report.html").read_text()
    assert "Views, in the order in which they were chosen" in report
    assert "lowers the expected uncertainty by" in report


def test_choices_follow_from_the_plan(whole: CellFolder) -> None:
    assert _chosen_anew(whole, whole.run_folder) == Run(whole.run_folder).chosen_views()


def test_a_complete_run_is_not_gone_on_with(whole: CellFolder) -> None:
    before = (whole.run_folder / "journal.jsonl").read_text()
    ended = whole.acquire("--resume", whole.run_folder)
    assert ended.code == 0, ended.err
    added = (whole.run_folder / "journal.jsonl").read_text().removeprefix(before)
    assert "chosen_view" not in added
    assert '"frame"' not in added


def _ended_early(run: Path, copy: Path, *, with_line: bool) -> None:
    """Copy a run as if its machine had failed before, or right after, the line of its second choice."""
    lines = (run / "journal.jsonl").read_text().splitlines()
    chosen_places = [place for place, line in enumerate(lines) if '"chosen_view"' in line]
    kept_lines = lines[: chosen_places[1] + with_line]
    later_views = {f"{view}.h5" for view in Run(run).views[1:]}
    shutil.copytree(run, copy, ignore=lambda _, names: later_views & set(names))
    (copy / "journal.jsonl").write_text("\n".join(kept_lines) + "\n")
    listed = [line for line in (run / "manifest.sha256").read_text().splitlines() if "inputs/" in line]
    (copy / "manifest.sha256").write_text("\n".join(listed) + "\n")


@pytest.mark.parametrize("with_line", [False, True])
def test_a_run_that_ended_between_two_views_goes_on_to_the_same_views(
    tmp_path: Path, whole: CellFolder, *, with_line: bool
) -> None:
    run = tmp_path / "run"
    _ended_early(whole.run_folder, run, with_line=with_line)
    status = _status(run)
    assert (status["state"], status["wants_views"], status["most_views"]) == ("interrupted", True, 3)
    assert f"--resume {run}" in status["go_on"]
    assert not verify(Run(run)).ok
    refused = cells.here("archive", run)
    assert refused.code == 5
    assert ("frames are missing" if with_line else "its views are not all chosen yet") in refused.err
    allowed = cells.here("check", whole.plan, "--json").document
    ended = whole.acquire("--resume", run)
    assert ended.code == 0, ended.err
    assert Run(run).chosen_views() == Run(whole.run_folder).chosen_views()
    assert len(cells.events(run, "frame")) == allowed["frames"]
    assert verify(Run(run)).ok
    assert _status(run)["dose_lux_h"] <= 1.0001 * allowed["dose_lux_h"]


def test_console_and_scripts_see_the_chosen_views_alone(whole: CellFolder, tmp_path: Path) -> None:
    run = whole.run_folder
    watched = RunWatch(RunFiles(run.parent, tmp_path)).of(run.name)
    assert [view for view, _, _ in watched.views] == Run(run).views
    assert all(proven == expected > 12 for _, proven, expected in watched.views)
    said = [words for _, words in watched.events]
    assert any(words.startswith(f"next view {Run(run).views[0]}: lowers") for words in said)
    assert any(words.startswith("no more views: enough by `views`") for words in said)
    opened = coupole.open_run(run)
    assert list(opened.views) == Run(run).views
    assert (opened.wants_views, opened.missing) == (False, ())


@pytest.mark.parametrize("frames", in_part([10, 1, 25, 45], 25))
def test_a_killed_run_goes_on_to_the_same_views(tmp_path: Path, whole: CellFolder, frames: int) -> None:
    cell = _cell(tmp_path, speed=2.0)
    process = cell.start_acquire(anew=True)
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) >= frames, "proven frames")
    process.kill()
    cells.finish(process)
    before = Run(run)
    assert before.wants_views or len(before.views) == 3
    assert not verify(before).ok
    if before.wants_views:
        status = _status(run)
        assert status["wants_views"]
        assert "--resume" in status["go_on"]
    chosen_before = before.chosen_views()
    ended = cell.acquire("--resume", run)
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0
    chosen = Run(run).chosen_views()
    assert chosen[: len(chosen_before)] == chosen_before
    assert chosen == Run(whole.run_folder).chosen_views()
    assert verify(Run(run)).ok


@pytest.mark.parametrize(
    ("until", "key"),
    in_part(
        [
            ({"frames": 60}, "frames"),
            ({"seconds": 5.0}, "seconds"),
            ({"lux_h": 0.01}, "lux_h"),
            ({"gain": 0.9}, "gain"),
        ],
        ({"frames": 60}, "frames"),
    ),
)
def test_it_stops_by_what_was_asked(tmp_path: Path, until: dict[str, float], key: str) -> None:
    cell = _cell(tmp_path, views=6, **until)
    allowed = cells.here("check", cell.plan, "--json").document
    job = without_hidden(read_job(cell.plan))
    next_views, chosen_views = NextViews(job, job.plan.views.until), list[ChosenView]()
    while not chosen_views or chosen_views[-1].view:
        chosen_views.append(next_views.choose(chosen_views, job.schedule))
    last = chosen_views[-1]
    assert last.reason.startswith(f"enough by `{key}`")
    assert last.figures["views"] < 6
    if key != "gain":
        assert last.figures["views"] > 0
        assert last.figures[key] <= until[key]
        figure = {"seconds": "duration_s", "lux_h": "dose_lux_h"}.get(key, key)
        choices_s = CHOICE_S * 6 if key == "seconds" else 0.0
        assert last.figures[key] <= allowed[figure] <= until[key] * (1 + 1e-9) + choices_s


def test_it_stops_when_enough_of_the_object_is_shown(tmp_path: Path) -> None:
    cell = _cell(tmp_path, views=6, coverage=0.5)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    *chosen_views, last = Run(cell.run_folder).chosen_views()
    assert last.reason.startswith("enough by `coverage`")
    assert last.figures["coverage"] >= 0.5
    assert all(chosen.figures["coverage"] < 0.5 for chosen in chosen_views)
    assert ended.document["shots"] == ended.document["proven"] == 12 * len(chosen_views)
    assert verify(Run(cell.run_folder)).ok


def test_lights_may_be_chosen_too(tmp_path: Path) -> None:
    cell = _cell(tmp_path, views=2)
    cell.write(lights=ADAPTIVE_LIGHTS)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    run = Run(cell.run_folder)
    assert len(run.views) == 2
    assert set(run.choices()) == set(run.views)
    assert ended.document["shots"] == ended.document["proven"] == 32
    assert (run.open_views(), run.wants_views) == ([], False)
    assert verify(run).ok
    assert _status(run.folder)["dose_lux_h"] <= run.chosen_views()[-1].figures["lux_h"]


def test_exposures_may_be_chosen_too(tmp_path: Path) -> None:
    cell = _cell(tmp_path, views=2)
    cell.write(
        exposure={"kind": "auto", "shortest_us": 2000, "longest_us": 16000}, lights={"kind": "every", "every": 45}
    )
    allowed = cells.here("check", cell.plan, "--json").document
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    run = Run(cell.run_folder)
    assert len(run.views) == 2
    assert set(run.choices()) == set(run.views)
    assert verify(run).ok
    assert _status(run.folder)["dose_lux_h"] <= 1.0001 * allowed["dose_lux_h"]
    assert len(cells.events(run.folder, "frame")) <= allowed["frames"]


@pytest.mark.parametrize(
    "change",
    in_part([{"view": "ring-az9-el9"}, {"view": "ring-az-30-el50", "twice": True}], {"view": "ring-az9-el9"}),
)
def test_a_changed_choice_is_not_gone_on_with(whole: CellFolder, tmp_path: Path, change: dict[str, Any]) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run_folder, run)
    journal = run / "journal.jsonl"
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    for line in [line for line in lines if line["event"] == "chosen_view"][: 2 if "twice" in change else 1]:
        line["view"] = change["view"]
    journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    ended = whole.acquire("--resume", run)
    assert ended.code == 6
    assert "a choice that its plan does not allow" in ended.err
    assert any("a choice that the run's plan does not allow" in problem for problem in verify(Run(run)).bad)


def test_a_frame_before_the_choice_of_its_view_is_found(whole: CellFolder, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run_folder, run)
    journal = run / "journal.jsonl"
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    first = next(line for line in lines if line["event"] == "chosen_view")
    lines.remove(first)
    lines.append(first)
    journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert any("its view was not chosen before" in problem for problem in verify(Run(run)).bad)


@pytest.mark.parametrize(("key", "limit"), [("frames", 3), ("seconds", 0.1), ("lux_h", 1e-9)])
def test_a_limit_that_allows_no_view_is_refused(tmp_path: Path, key: str, limit: float) -> None:
    refused = cells.here("check", _cell(tmp_path, **{key: limit}).plan, "--json")
    assert refused.code == 3
    assert any(f"`{key}` of `until` allows no view" in refusal for refusal in refused.document["refusals"])


def test_each_candidate_must_be_reached(tmp_path: Path) -> None:
    cell = _cell(tmp_path)
    below = {**RING, "name": "below", "azimuths_deg": [0], "elevations_deg": [-60]}
    cell.write(views={"kind": "adaptive", "candidates": [RING, below], "until": {"views": 1}})
    refused = cells.here("check", cell.plan, "--json")
    assert refused.code == 3
    assert any(refusal.startswith("view below-az0-el-60:") for refusal in refused.document["refusals"])


def test_the_whole_set_is_rehearsed_in_a_dry_run(tmp_path: Path) -> None:
    cell = _cell(tmp_path, views=2)
    ended = cells.here("acquire", cell.plan, "--dry-run", "--json")
    assert ended.code == 0, ended.err
    assert (ended.document["shots"], ended.document["proven"]) == (24, 24)
    assert ended.document["duration_s"] <= 1.3 * ended.document["preflight_s"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"object": {"id": "relief"}}, "an object with a `mesh`"),
        ({"lights": {"kind": "panels"}}, "LEDs with `views: {kind: adaptive}`"),
        ({"order": "as_written"}, "no `order: as_written`"),
        ({"discard": "after_fit"}, "no `discard`"),
        ({"watch": True, "exposure": {"kind": "auto", "longest_us": 8000}}, "`watch: {frames: darks}`"),
        ({"views": {"kind": "adaptive", "until": {"views": 2}}}, "missing key `candidates`"),
        ({"views": {"kind": "adaptive", "candidates": [], "until": {"views": 2}}}, "at least 1"),
        ({"views": {"kind": "adaptive", "candidates": [RING]}}, "missing key `until`"),
        ({"views": {"kind": "adaptive", "candidates": [RING], "until": {"frames": 9}}}, "missing key `views`"),
        ({"views": {"kind": "adaptive", "candidates": [RING], "until": {"views": 0}}}, "from 1 to 400"),
        ({"views": {"kind": "adaptiv", "candidates": [RING], "until": {"views": 1}}}, "did you mean `adaptive`"),
        (
            {"views": {"kind": "adaptive", "candidates": [{**RING, "distance": 1}], "until": {"views": 1}}},
            "unknown key `distance`",
        ),
        (
            {"views": {"kind": "adaptive", "candidates": [{**RING, "lights": FEW_LIGHTS}], "until": {"views": 1}}},
            "without `lights` of their own",
        ),
        (
            {
                "views": {
                    "kind": "adaptive",
                    "candidates": [{**RING, "azimuths_deg": list(range(201))}],
                    "until": {"views": 1},
                }
            },
            "at most 400 candidates, found 402",
        ),
    ],
)
def test_what_cannot_be_chosen_is_refused_at_its_place(tmp_path: Path, change: Any, message: str) -> None:
    cell = _cell(tmp_path)
    cell.write(**change)
    refused = cells.here("check", cell.plan)
    assert refused.code == 2
    said = " ".join((refused.out + refused.err).split())
    assert message in said
    assert "plan.yaml:" in said


def test_a_planned_view_still_needs_no_choice(tmp_path: Path) -> None:
    schedule = read_job(_cell(tmp_path).plan).schedule
    alone = schedule.only_views({"ring-az-30-el50"})
    assert (alone.view_count, alone.most_views, schedule.view_count) == (1, None, 3)
    assert np.isclose(schedule.frames, 3 * alone.frames)

"""Runs whose exposures are chosen while they run: what is chosen stands in the journal first, and it follows from
the frames alone, also over a kill."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import SIDE, TOP, CellFolder
from in_part import in_part

from coupole.acquisition.frame_samples import frame_sample
from coupole.plan.choices import FrameSample
from coupole.plan.exposures import AutoExposure
from coupole.plan.shot_id import ShotLabel
from coupole.preflight.choosers import chooser_of
from coupole.preflight.job import read_job
from coupole.storage.run import Run
from coupole.storage.verification import verify

AUTO = {"kind": "auto", "shortest_us": 500, "longest_us": 64000, "snr": 20}


def _cell(folder: Path, speed: float = 5.0) -> CellFolder:
    cell = CellFolder(folder, speed=speed)
    cell.write(views=[TOP, SIDE], exposure=AUTO)
    return cell


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    """A run that nobody disturbed."""
    cell = _cell(tmp_path_factory.mktemp("whole"))
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    return cell


def _lit(run: Path) -> dict[tuple[str, int], list[tuple[int, float]]]:
    """Exposure and clipped share of the frames of each LED of each view, shortest first."""
    found: dict[tuple[str, int], list[tuple[int, float]]] = {}
    for shot, frame in cells.stored(run).items():
        if cells.is_light(shot):
            share = float(np.mean(frame.pixels >= 4095))
            key = (shot.split("/")[0], int(frame.record["led"]))
            found.setdefault(key, []).append((int(frame.record["exposure_us"]), share))
    return {key: sorted(own) for key, own in found.items()}


def test_no_led_clips_more_than_allowed_and_each_is_taken(whole: CellFolder) -> None:
    lit = _lit(whole.run_folder)
    assert len(lit) == 2 * 54
    assert max(own[0][1] for own in lit.values()) <= 1e-3
    assert all(len({time_us for time_us, _ in own}) <= 3 for own in lit.values())


def test_places_in_shot_ids_are_the_ladder_of_the_plan(whole: CellFolder) -> None:
    times_us = AutoExposure.model_validate(AUTO).exposures_us
    for shot, frame in cells.stored(whole.run_folder).items():
        place = int(shot.split("/e")[1].split("/")[0])
        assert frame.record["exposure_us"] == times_us[place]


def test_a_run_costs_no_more_than_preflight_says(whole: CellFolder) -> None:
    allowed = cells.here("check", whole.plan, "--json").document
    status = cells.here("status", whole.run_folder, "--json").document
    assert 0 < status["dose_lux_h"] <= allowed["dose_lux_h"]
    assert sum(expected for _, expected in status["views"].values()) <= allowed["frames"]
    assert status["open_views"] == []


def test_a_run_is_verified_and_its_report_says_what_was_chosen(whole: CellFolder) -> None:
    assert cells.here("verify", whole.run_folder).code == 0
    report = (whole.run_folder / "report.html").read_text()
    for choices in Run(whole.run_folder).choices().values():
        assert choices[-1].bursts == ()
        assert all(choice.reason in report for choice in choices)


def test_a_frame_that_nobody_chose_is_found(whole: CellFolder, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run_folder, run)
    journal = run / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    first = next(n for n, line in enumerate(lines) if json.loads(line)["event"] == "chosen")
    journal.write_text("".join(lines[:first] + lines[first + 1 :]))
    assert any("was not chosen before it was proven" in problem for problem in verify(Run(run)).bad)


def test_a_choice_of_another_time_is_found(whole: CellFolder, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run_folder, run)
    journal = run / "journal.jsonl"
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    next(line for line in lines if line["event"] == "chosen")["bursts"][0]["exposure_us"] += 1
    journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert any("was chosen as" in problem for problem in verify(Run(run)).bad)


def _chosen_anew(cell: CellFolder, run: Path) -> dict[str, list[Any]]:
    """What follows from the frames that are on the disk, choice by choice."""
    job, opened = read_job(cell.plan), Run(run)
    chooser, stored, chosen = chooser_of(job), cells.stored(run), {}
    assert chooser is not None
    made = opened.choices()
    for number, pose in enumerate(job.schedule.views):
        view, known = job.schedule.open_view(number), made[pose.name]
        samples: dict[ShotLabel, FrameSample] = {}
        for place, choice in enumerate(known):
            anew = view.with_darks(known[:place], chooser.choose(view, tuple(known[:place]), dict(samples)))
            chosen.setdefault(pose.name, []).append(anew)
            for label in (label for burst in choice.bursts for label in burst.labels()):
                pixels = stored[f"{pose.name}/{label}"].pixels
                samples[label] = frame_sample(pixels, cells.BLACK_DN, 4095)
    return chosen


def test_choices_follow_from_the_frames(whole: CellFolder) -> None:
    assert _chosen_anew(whole, whole.run_folder) == Run(whole.run_folder).choices()


@pytest.mark.parametrize("frames", in_part([40, 3, 120]))
def test_a_killed_run_goes_on_as_its_frames_ask(tmp_path: Path, frames: int) -> None:
    cell = _cell(tmp_path, speed=2.0)
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) >= frames, "proven frames")
    process.kill()
    cells.finish(process)
    chosen_before = Run(run).choices()
    status = cells.here("status", run, "--json").document
    assert status["open_views"]
    assert status["go_on"]
    assert verify(Run(run)).bad == []
    ended = cell.acquire("--resume", run)
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0
    chosen = Run(run).choices()
    assert all(chosen[view][: len(made)] == made for view, made in chosen_before.items())
    assert chosen == _chosen_anew(cell, run)
    assert verify(Run(run)).ok
    planned, given = (cells.events(run, kind) for kind in ("begin", "burst"))
    allowed = cells.here("check", cell.plan, "--json").document
    at_most = sum(max(line["planned_lux_h"]) for line in planned)
    assert sum(max(line["given_lux_h"]) for line in given) <= at_most
    assert cells.here("status", run, "--json").document["dose_lux_h"] <= allowed["dose_lux_h"]


def test_a_resumed_run_that_is_complete_moves_nothing(whole: CellFolder) -> None:
    choices, moves = Run(whole.run_folder).choices(), cells.events(whole.run_folder, "move")
    assert whole.acquire("--resume", whole.run_folder).code == 0
    assert Run(whole.run_folder).choices() == choices
    assert cells.events(whole.run_folder, "move") == moves


def test_a_dry_run_chooses_too(tmp_path: Path) -> None:
    cell = _cell(tmp_path)
    ended = cells.here("acquire", cell.plan, "--dry-run", "--speed", "20", "--json")
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0
    assert ended.document["shots"] >= 108


def test_a_light_budget_that_the_worst_case_exceeds_is_refused(tmp_path: Path) -> None:
    cell = _cell(tmp_path)
    allowed = cells.here("check", cell.plan, "--json").document
    cell.plan_data["object"]["dose_budget_lux_h"] = 0.9 * allowed["dose_lux_h"]
    cell.write()
    refused = cell.acquire()
    assert refused.code == 3
    assert "its budget is" in refused.err + refused.out

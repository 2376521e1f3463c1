"""Runs that are watched: what happens in the simulated cell is found, named, marked, and taken again."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import cells
import pytest
from cells import CellFolder
from real_cells import true_dose_lux_h

from coupole.acquisition.watching import burst_judge
from coupole.errors import ChecksumMismatch
from coupole.preflight.job import read_job
from coupole.storage.journal_events import FrameProven
from coupole.storage.view_reader import View

EVERY = {"kind": "every", "every": 20}


def _watched(cell: CellFolder, watch: object, *faults: dict[str, Any]) -> cells.Ended:
    cell.world_settings["camera"] = {"samples_per_side": 3}
    cell.write(watch=watch, lights=EVERY)
    cell.faults(*faults)
    return cell.acquire()


def _found(cell: CellFolder) -> list[dict[str, Any]]:
    return cells.events(cell.run_folder, "finding")


FAULTS: dict[str, dict[str, Any]] = {
    "ambient light": {"kind": "room_lamp", "lux": 10, "at_edge": 40},
    "LED": {"kind": "dim_led", "led": 0, "loss": 0.1, "at_edge": 40},
    "drift": {"kind": "warming", "per_s": -0.1, "at_edge": 10},
    "moved": {"kind": "bump", "what": "object", "mm": [0.2, 0.0, 0.0], "at_edge": 40},
    "smudge": {"kind": "smudge", "transmission": 0.85, "radius": 0.2, "at_edge": 40},
    "exposure step": {"kind": "exposure_step", "factor": 1.05, "at_edge": 40},
    "thing in the field": {"kind": "hand", "seconds": 0.3, "at_edge": 20},
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_is_found_and_named_and_has_a_picture(cell: CellFolder, kind: str) -> None:
    cell.write(watch=True, lights=EVERY)
    sentinels = [str(label) for label in read_job(cell.plan).schedule.labels[0] if "watch" in str(label)]
    fault = FAULTS[kind] | ({"led": int(sentinels[0][3:7])} if kind == "LED" else {})
    ended = _watched(cell, True, fault)
    assert ended.code == 0, ended
    (found,) = _found(cell)
    assert found["kind"] == kind
    assert found["figure"] > found["limit"]
    assert found["shots"]
    assert (cell.run_folder / found["picture"]).read_bytes().startswith(b"\x89PNG")
    status = cells.here("status", cell.run_folder, "--json")
    assert len(status.document["findings"]) == 1
    status = cells.here("status", cell.run_folder)
    assert kind in status.err


def test_a_clean_run_with_sentinels_has_no_finding_and_all_its_frames(cell: CellFolder) -> None:
    ended = _watched(cell, True)
    assert ended.code == 0
    assert _found(cell) == []
    assert ended.document["shots"] == ended.document["proven"] == 54
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_what_a_hand_has_spoilt_is_taken_again(cell: CellFolder) -> None:
    ended = _watched(cell, {"retake": True}, FAULTS["thing in the field"])
    assert ended.code == 0, ended
    (found,) = _found(cell)
    (again,) = cells.events(cell.run_folder, "reshoot")
    assert set(again["shots"]) == set(found["shots"])
    assert ended.document["reshot"] == len(found["shots"])
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_under_a_lamp_all_is_taken_again_as_often_as_the_plan_says_then_kept_and_marked(cell: CellFolder) -> None:
    cell.plan_data["reshoot_limit"] = 1
    ended = _watched(cell, {"retake": True}, FAULTS["ambient light"])
    assert ended.code == 0, ended
    assert [found["kind"] for found in _found(cell)] == 2 * ["ambient light"]
    assert ended.document["reshot"] == 54
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_without_a_word_in_the_plan_a_lamp_is_found_by_the_dark_frames(cell: CellFolder) -> None:
    cell.faults(FAULTS["ambient light"])
    assert cell.acquire().code == 0
    assert [found["kind"] for found in _found(cell)] == ["ambient light"]


def test_a_run_that_is_not_watched_finds_nothing(cell: CellFolder) -> None:
    assert _watched(cell, False, FAULTS["ambient light"]).code == 0
    assert _found(cell) == []


def test_sentinels_are_refused_where_lights_are_chosen(cell: CellFolder) -> None:
    lights = {"kind": "adaptive", "until": {"lights": 32}}
    cell.write(watch=True, lights=lights)
    ended = cells.here("check", cell.plan)
    assert ended.code == 2
    line = next(n for n, line in enumerate(cell.plan.read_text().splitlines(), 1) if '"watch"' in line)
    assert f"{cell.plan}:{line}:11: watch: expected `watch: {{frames: darks}}`" in ended.err


# -- light, frames and words, whatever happens ----------------------------------------------------------------


def _cell_of_its_own_world(folder: Path, watch: object) -> CellFolder:
    cell = CellFolder(folder, speed=2.0)
    cell.join()
    cell.write(watch=watch, lights=EVERY, reshoot_limit=1)
    return cell


def _told_lux_h(cell: CellFolder) -> float:
    return float(cells.here("status", cell.run_folder, "--json").document["dose_lux_h"])


def test_sentinels_and_what_is_taken_again_are_counted_by_ledger_and_preflight(tmp_path: Path) -> None:
    cell = _cell_of_its_own_world(tmp_path, {"retake": True})
    planned = cells.here("check", cell.plan, "--json", "--no-paths").document
    cell.write(watch=False)
    unwatched = cells.here("check", cell.plan, "--json", "--no-paths").document
    cell.write(watch={"retake": True})
    assert planned["dose_lux_h"] > 1.1 * unwatched["dose_lux_h"]  # 54 LEDs and 8 sentinels
    with cell.world(FAULTS["ambient light"]) as world:
        assert cell.acquire().code == 0
        truth = float(true_dose_lux_h(cell, world).max())
    told = _told_lux_h(cell)
    assert truth <= told * 1.001
    assert told < 1.2 * truth
    assert told > 1.7 * planned["dose_lux_h"]  # all shots were taken twice, sentinels once
    assert cells.here("verify", cell.run_folder).code == 0
    cells.assert_each_shot_proven_once(cell.run_folder)


@pytest.mark.parametrize("proven", [0, 70])
def test_a_killed_run_that_takes_again_goes_on_and_no_light_is_forgotten(tmp_path: Path, proven: int) -> None:
    """Frames wait for their burst's judgement: what a kill takes with it is taken again, and its light counted."""
    cell = _cell_of_its_own_world(tmp_path, {"retake": True})
    cell.write(views=[cells.TOP, cells.LOW])
    with cell.world() as world:
        process = cell.start_acquire()
        cells.wait_until(lambda: len(cells.events(cell.run_folder, "frame")) >= proven, "frames")
        cells.wait_until(lambda: world.ask("light")["leds_s"], "light")
        process.kill()
        cells.finish(process)
        cells.wait_until(lambda: not world.ask("state")["shining"], "the dark")
        cell.confirm()
        resumed = cell.acquire("--resume", cell.run_folder)
        assert resumed.code == 0, resumed.err
        assert float(true_dose_lux_h(cell, world).max()) <= _told_lux_h(cell) * 1.001
    assert _found(cell) == []
    cells.assert_each_shot_proven_once(cell.run_folder)
    assert cells.here("verify", cell.run_folder).code == 0


@pytest.mark.parametrize("watch", [True, {"retake": True}])
def test_a_defect_of_the_judge_costs_no_frame_and_is_told(
    cell: CellFolder, watch: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> list[object]:
        raise ZeroDivisionError("of its own making")

    monkeypatch.setattr(burst_judge.BurstJudge, "judge", fail)
    ended = _watched(cell, watch, FAULTS["ambient light"])
    assert ended.code == 0, ended.err
    assert ended.document["proven"] == 54
    (found,) = _found(cell)
    assert found["kind"] == "not watched"
    assert "ZeroDivisionError: of its own making" in found["message"]
    assert "the run goes on" in cells.here("status", cell.run_folder).err
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_a_picture_that_cannot_be_kept_costs_no_frame(cell: CellFolder) -> None:
    cell.faults(FAULTS["ambient light"])
    process = cell.start_acquire()
    (cell.run_folder / "watch").write_text("in the way of the folder")
    ended = cells.finish(process)
    assert ended.code == 0, ended.err
    (found,) = _found(cell)
    assert (found["kind"], found["picture"]) == ("ambient light", "")


# -- frames of other attempts and other views -----------------------------------------------------------------


def test_a_lamp_that_is_on_only_while_a_lost_shot_is_taken_again_is_found(cell: CellFolder) -> None:
    """Dark marks of what is taken again are kept nowhere, but they tell of the room."""
    cell.write(lights=EVERY)
    burst = read_job(cell.plan).schedule.bursts[0][0]
    lost, edges = burst.inner[len(burst.inner) // 2], len(burst.labels)
    cell.faults({"kind": "drop_trigger", "edge": lost}, {"kind": "room_lamp", "lux": 10, "at_edge": edges})
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] == 1
    (found,) = _found(cell)
    assert found["kind"] == "ambient light"
    assert f"top/{burst.labels[lost]}" in found["shots"]
    assert set(found["shots"]) <= {f"top/{label}" for label in cells.labels(cell.run_folder)}


def test_a_frame_lost_in_one_view_is_not_judged_by_the_same_light_in_the_view_before(cell: CellFolder) -> None:
    cell.write(views=[cells.TOP, cells.LOW], order="as_written")
    ended = _watched(cell, True, *({"kind": "drop_trigger", "edge": edge} for edge in range(100, 110)))
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] > 0
    assert _found(cell) == []


def _begun_and_killed(cell: CellFolder) -> set[str]:
    """Begin a run and kill it within its view. Shots that are proven."""
    cell.write(lights={"kind": "every", "every": 6})
    with cell.world() as world:
        process = cell.start_acquire()
        cells.wait_until(lambda: len(cells.events(cell.run_folder, "frame")) > 20, "frames")
        process.kill()
        cells.finish(process)
        cells.wait_until(lambda: not world.ask("state")["shining"], "the dark")
    shots = {str(event["shot"]) for event in cells.events(cell.run_folder, "frame")}
    assert len(shots) < 160  # of 180, and sentinels
    return shots


BETWEEN = {
    "moved": {"kind": "bump", "what": "object", "mm": [0.3, 0.0, 0.0], "at_edge": 1},
    "drift": {"kind": "exposure_step", "factor": 1.05, "at_edge": 1},
}


@pytest.mark.parametrize("kind", [None, *BETWEEN])
def test_what_changed_between_two_sessions_of_a_view_is_found(tmp_path: Path, kind: str | None) -> None:
    """The later session's sentinels are compared with the first ones of the earlier."""
    cell = _cell_of_its_own_world(tmp_path, True)
    cell.world_settings["camera"] = {"samples_per_side": 3}
    before = _begun_and_killed(cell)
    with cell.world(*([BETWEEN[kind]] if kind else [])):
        cell.confirm()
        resumed = cell.acquire("--resume", cell.run_folder)
    assert resumed.code == 0, resumed.err
    assert [finding["kind"] for finding in _found(cell)] == ([kind] if kind else [])
    assert all(not before & set(finding["shots"]) for finding in _found(cell))
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_a_sentinel_of_the_session_before_that_cannot_be_read_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = _cell_of_its_own_world(tmp_path, True)
    _begun_and_killed(cell)

    def unreadable(view: View, _: FrameProven) -> NoReturn:
        raise ChecksumMismatch(f"{view.path}: not what was proven")

    monkeypatch.setattr(View, "proven_pixels", unreadable)
    with cell.world():
        cell.confirm()
        resumed = cell.acquire("--resume", cell.run_folder)
    assert resumed.code == 0, resumed.err
    (finding,) = _found(cell)
    assert finding["kind"] == "not watched"
    assert finding["message"].startswith("not compared with the session before: ")
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_a_lamp_that_comes_on_in_a_burst_that_a_resumed_run_completes_is_found(tmp_path: Path) -> None:
    """The burst's first marks are in the file already; those of the new session are looked at all the same."""
    cell = CellFolder(tmp_path, speed=1.0)
    cell.join()
    cell.write(lights={"kind": "every", "every": 6})
    with cell.world() as world:
        process = cell.start_acquire()
        cells.wait_until(lambda: cells.events(cell.run_folder, "frame"), "frames")
        process.kill()
        cells.finish(process)
        cells.wait_until(lambda: not world.ask("state")["shining"], "the dark")
    before = {event["shot"] for event in cells.events(cell.run_folder, "frame")}
    assert 0 < len(before) < 160  # of 180 and dark ones
    with cell.world({"kind": "room_lamp", "lux": 10, "at_edge": 10}):
        cell.confirm()
        resumed = cell.acquire("--resume", cell.run_folder)
    assert resumed.code == 0, resumed.err
    (found,) = _found(cell)
    assert found["kind"] == "ambient light"
    assert found["shots"]
    assert not before & set(found["shots"])
    cells.assert_each_shot_proven_once(cell.run_folder)

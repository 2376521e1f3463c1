"""What can go wrong in a cell, one fault at a time: it is noticed, named, made good where that is possible, and
the cell is safe afterwards in any case.

The world stands by itself, so that it can be asked for its state when the controller has ended.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import SIDE, TOP, CellFolder, Ended
from expected_pictures import mislabelled
from failures import MORE_LIGHTS, assert_complete_once_mended, assert_told, fail_in_a_burst
from small_disks import small_disk_at

FRAMES = 66
"""Of one view: 54 lights, two dark frames, ten marks."""


@pytest.fixture
def joining(cell: CellFolder) -> CellFolder:
    """A cell of one view whose world is kept by the test."""
    cell.join()
    return cell


def _acquire_with(cell: CellFolder, *faults: dict[str, Any], **settings: Any) -> Ended:
    """Run the plan in a world in which `faults` happen."""
    with cell.world(*faults, **settings) as world:
        ended = cell.acquire()
        assert cells.safe(world)
    return ended


def _assert_made_good(cell: CellFolder, ended: Ended, reshot: list[int]) -> None:
    """The run is complete, its labels are true, and just the shots of these edges were taken again."""
    run = cell.run_folder
    assert ended.code == 0, ended.err
    cells.assert_each_shot_proven_once(run)
    labels = cells.labels(run)
    wanted = {f"top/{labels[edge]}" for edge in reshot if cells.is_light(f"top/{labels[edge]}")}
    assert set(cells.reshot(run)) == wanted
    assert ended.document["reshot"] == len(wanted)
    assert mislabelled(cell, run) == []


def _total(run: Path, counter: str) -> int:
    """One of the camera's counters, over all bursts."""
    return sum(event["camera"][counter] for event in cells.events(run, "burst"))


# -- lost and surplus frames ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "edge",
    [
        pytest.param(0, id="first"),
        pytest.param(7, id="first-light", marks=pytest.mark.full),
        pytest.param(30, id="middle", marks=pytest.mark.full),
        pytest.param(60, id="last-light", marks=pytest.mark.full),
        pytest.param(65, id="last"),
    ],
)
def test_a_dropped_trigger_has_its_shot_taken_again(joining: CellFolder, edge: int) -> None:
    ended = _acquire_with(joining, {"kind": "drop_trigger", "edge": edge})
    _assert_made_good(joining, ended, [edge])


@pytest.mark.parametrize("frame", [pytest.param(0, marks=pytest.mark.full), 65], ids=["first", "last"])
def test_a_frame_lost_in_transfer_is_taken_again(joining: CellFolder, frame: int) -> None:
    ended = _acquire_with(joining, {"kind": "lost_transfer", "frame": frame})
    _assert_made_good(joining, ended, [frame])
    assert _total(joining.run_folder, "lost_transfers") == 1


def test_a_gap_in_the_frame_ids_is_called_a_lost_transfer(joining: CellFolder) -> None:
    """At a burst's ends there is no id beside the gap: such a frame is only said to be missing."""
    _acquire_with(joining, {"kind": "lost_transfer", "frame": 30}, {"kind": "drop_trigger", "edge": 40})
    (gap,) = cells.events(joining.run_folder, "gap")
    assert (gap["missing"], gap["lost_in_transfer"]) == (2, 1)


@pytest.mark.parametrize("delay_us", [300, pytest.param(9_500, marks=pytest.mark.full)])
def test_a_bounce_that_the_camera_ignores_costs_nothing(joining: CellFolder, delay_us: int) -> None:
    """While it exposes or reads out, the camera counts a second pulse and makes no frame."""
    ended = _acquire_with(joining, {"kind": "double_trigger", "edge": 30, "delay_us": delay_us})
    _assert_made_good(joining, ended, [])
    assert _total(joining.run_folder, "over_triggers") == 1


def test_a_bounce_that_makes_a_surplus_frame_and_hides_the_next_edge_is_found(joining: CellFolder) -> None:
    """With a fast readout the camera is ready again before the next edge: the bounce's frame shows two LEDs, and
    the edge after it comes too early."""
    joining.rig_data["sensor"]["max_frames_per_s"] = 200
    joining.write()
    ended = _acquire_with(joining, {"kind": "double_trigger", "edge": 30, "delay_us": 8_150})
    _assert_made_good(joining, ended, [31])
    assert sum(event["surplus"] for event in cells.events(joining.run_folder, "gap")) == 1


def test_many_faults_in_one_burst_are_told_apart(joining: CellFolder) -> None:
    """Frame numbers count what was exposed: the two edges dropped before it are not in frame 40's number."""
    ended = _acquire_with(
        joining,
        {"kind": "drop_trigger", "edge": 8},
        {"kind": "drop_trigger", "edge": 9},
        {"kind": "double_trigger", "edge": 20},
        {"kind": "lost_transfer", "frame": 40},
        {"kind": "lost_transfer", "frame": 41},
        {"kind": "drop_trigger", "edge": 65},
    )
    _assert_made_good(joining, ended, [8, 9, 42, 43, 65])


def test_a_trigger_that_is_lost_again_when_shot_again_is_tried_once_more(joining: CellFolder) -> None:
    """The second burst has one light between its ten marks: its sixth edge."""
    again = FRAMES + 5
    ended = _acquire_with(joining, {"kind": "drop_trigger", "edge": 30}, {"kind": "drop_trigger", "edge": again})
    run = joining.run_folder
    assert ended.code == 0, ended.err
    shot = f"top/{cells.labels(run)[30]}"
    assert cells.reshot(run) == [shot, shot]
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(joining, run) == []


def test_a_fault_in_the_second_view_is_made_good_there(joining: CellFolder) -> None:
    joining.write(views=[TOP, SIDE], order="as_written")
    ended = _acquire_with(joining, {"kind": "drop_trigger", "edge": FRAMES + 20})
    assert ended.code == 0, ended.err
    run = joining.run_folder
    assert cells.reshot(run) == [f"side/{cells.labels(run)[20]}"]
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(joining, run) == []


def test_frame_ids_that_wrap_in_a_burst_are_followed(joining: CellFolder) -> None:
    ended = _acquire_with(joining, camera={"first_frame_id": 65_500})
    _assert_made_good(joining, ended, [])
    ids = {event["frame_id"] for event in cells.events(joining.run_folder, "frame")}
    assert {65_535, 1} < ids
    assert 0 not in ids


def test_a_frame_lost_where_ids_wrap_is_taken_again(joining: CellFolder) -> None:
    ended = _acquire_with(joining, {"kind": "lost_transfer", "frame": 35}, camera={"first_frame_id": 65_500})
    _assert_made_good(joining, ended, [35])


def test_without_reshooting_a_dropped_trigger_ends_the_run_with_five_and_names_the_shot(
    joining: CellFolder,
) -> None:
    joining.write(reshoot_limit=0)
    ended = _acquire_with(joining, {"kind": "drop_trigger", "edge": 30})
    run = joining.run_folder
    assert ended.code == 5
    assert (ended.document["proven"], ended.document["missing"]) == (53, 1)
    assert f"top/{cells.labels(run)[30]}" in ended.err
    with joining.world():
        assert joining.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)


# -- lights ---------------------------------------------------------------------------------------------------


def test_a_dead_led_ends_the_run_with_five_and_is_named(joining: CellFolder) -> None:
    ended = _acquire_with(joining, {"kind": "dead_led", "led": 400})
    assert ended.code == 5
    assert "top/led0400/e0" in ended.err
    assert "drew no current" in ended.err
    found = ended.document
    assert (found["proven"], found["missing"], found["bad"]) == (53, 1, 1)
    assert set(cells.reshot(joining.run_folder)) == {"top/led0400/e0"}


def test_a_run_with_a_dead_led_is_complete_once_it_is_repaired(joining: CellFolder) -> None:
    assert _acquire_with(joining, {"kind": "dead_led", "led": 400}).code == 5
    with joining.world():
        assert joining.acquire("--resume", joining.run_folder).code == 0
    cells.assert_each_shot_proven_once(joining.run_folder)
    assert mislabelled(joining, joining.run_folder) == []


def test_a_flickering_led_changes_no_label(joining: CellFolder) -> None:
    joining.write(repeats=3)
    ended = _acquire_with(joining, {"kind": "flickering_led", "led": 400, "rms": 0.3})
    assert ended.code == 0, ended.err
    cells.assert_each_shot_proven_once(joining.run_folder)
    assert mislabelled(joining, joining.run_folder) == []


def test_an_led_that_was_dead_for_a_while_is_proven_when_it_is_taken_again(joining: CellFolder) -> None:
    """It is lit in the middle of the burst, and its contact is loose until just before the burst's end."""
    ended = _acquire_with(joining, {"kind": "dead_led", "led": 400, "at_edge": 0, "seconds": 0.6})
    assert ended.code == 0, ended.err
    assert cells.reshot(joining.run_folder) == ["top/led0400/e0"]
    assert mislabelled(joining, joining.run_folder) == []


def test_a_dark_frame_that_stays_unproven_ends_the_run_with_five_and_is_named(joining: CellFolder) -> None:
    """Its edge is lost in the burst, and in each of the three bursts of eleven edges that take it again."""
    faults = [{"kind": "drop_trigger", "edge": edge} for edge in (5, 71, 82, 93)]
    ended = _acquire_with(joining, *faults)
    assert ended.code == 5
    assert "1 frames are not proven after 3 re-shoots: top/dark10/e0" in ended.err
    assert (ended.document["missing"], ended.document["missing_darks"]) == (0, 1)
    assert cells.events(joining.run_folder, "stop")[-1]["outcome"] == "failed"
    with joining.world():
        assert joining.acquire("--resume", joining.run_folder).code == 0
    cells.assert_each_shot_proven_once(joining.run_folder)


# -- devices that fail ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "device", "words"),
    [
        ({"kind": "mute_box"}, "led box", ""),
        ({"kind": "cut_wire"}, "led box", ""),
        ({"kind": "over_temperature", "board": 3}, "led box", "temperature"),
        ({"kind": "unplug_camera"}, "camera", "link"),
    ],
    ids=["mute_box", "cut_wire", "over_temperature", "unplug_camera"],
)
def test_a_box_or_camera_that_fails_in_a_burst_ends_the_run_with_four_and_a_safe_cell(
    joining: CellFolder, fault: dict[str, Any], device: str, words: str
) -> None:
    ended = fail_in_a_burst(joining, fault)
    assert_told(joining, ended, device)
    assert words in ended.err
    assert_complete_once_mended(joining)


def test_a_mute_box_is_reported_with_what_was_expected_and_what_to_do(joining: CellFolder) -> None:
    with joining.world({"kind": "mute_box", "at_edge": 30}) as world:
        ended = joining.acquire()
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
    assert ended.document["kind"] == "DeviceTimeout"
    device, _, message = ended.document["error"].partition(": ")
    assert device == "led box"
    assert message.startswith("expected ")
    happened, _, remedy = message.partition("; ")[2].partition(". ")
    assert happened
    assert remedy


def test_a_camera_slower_than_the_rig_says_is_told_before_any_light(cell: CellFolder) -> None:
    """The world is made of what the rig said first; then the rig claims more."""
    cell.join()
    with cell.world() as world:
        cell.rig_data["sensor"]["max_frames_per_s"] = 150
        cell.write()
        ended = cell.acquire()
        assert cells.safe(world)
    assert ended.code == 4
    assert "camera: expected to be triggered at intervals of at least 10000 us" in ended.err
    assert cells.events(cell.run_folder, "burst") == []


def test_a_box_that_is_mute_from_the_start_is_reported_before_anything_moves(joining: CellFolder) -> None:
    with joining.world({"kind": "mute_box"}) as world:
        ended = joining.acquire()
        assert cells.safe(world)
    assert ended.code == 4
    assert "led box: expected" in ended.err
    assert not (joining.folder / "storage").exists()


def test_a_fault_at_a_time_of_the_world_is_met_whatever_the_run_does_then(joining: CellFolder) -> None:
    with joining.world({"kind": "unplug_camera", "at_s": 0.5}) as world:
        cells.wait_until(lambda: world.ask("state")["t_s"] > 0.5, "the fault's time")
        ended = joining.acquire()
        assert cells.safe(world)
    assert ended.code == 4
    assert "camera: expected" in ended.err


# -- the disk -------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk_at(tmp_path / "disk", kib=12 * 1024) as disk:
        yield disk


def _fill(path: Path) -> None:
    """Write until the disk is full."""
    with path.open("wb", buffering=0) as ballast, contextlib.suppress(OSError):
        while True:
            ballast.write(bytes(4096))


def test_a_disk_that_fills_up_in_a_burst_ends_the_run_with_six_and_it_is_resumed_on_more_space(
    tmp_path: Path, small_disk: Path
) -> None:
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["storage"]["folder"] = str(small_disk / "storage")
    cell.join()
    cell.write(lights=MORE_LIGHTS)
    with cell.world() as world:
        process = cell.start_acquire()
        (about,) = cells.wait_until(lambda: list((small_disk / "storage").glob("2*/run.json")), "a run folder")
        run = about.parent
        cells.wait_until(lambda: cells.frame_lines(run) > 20, "proven frames")
        _fill(small_disk / "ballast")
        ended = cells.finish(process)
        assert cells.safe(world)
        assert ended.code == 6
        assert ended.document["kind"] == "DiskFull", ended
        assert "disk is full" in ended.err
        (small_disk / "ballast").unlink()
        assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(cell, run) == []


def test_a_disk_with_too_little_room_for_a_views_file_ends_the_run_with_six_before_any_light(
    tmp_path: Path, small_disk: Path
) -> None:
    cell = CellFolder(tmp_path)
    cell.rig_data["storage"]["folder"] = str(small_disk / "storage")
    cell.join()
    with cell.world() as world:
        taker = threading.Thread(target=_take_room_from, args=(small_disk,))
        taker.start()
        ended = cell.acquire()
        taker.join()
        assert cells.safe(world)
        assert ended.code == 6, ended
        (small_disk / "ballast").unlink()
        run = next((small_disk / "storage").glob("2*"))
        assert cells.events(run, "burst") == []
        assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)


def _take_room_from(disk: Path) -> None:
    """Take free space as soon as a run is there: preflight has passed, and the arm is on its way. There is room
    for the frames of a view, but not for its spare slots."""
    cells.wait_until(lambda: [*disk.glob("storage/2*/run.json")], "a run")
    facts = os.statvfs(disk)
    with (disk / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, facts.f_bavail * facts.f_frsize - FRAMES * 24576 - 200_000)


def test_a_plan_that_does_not_fit_on_the_disk_is_refused_with_three(tmp_path: Path, small_disk: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.rig_data["storage"]["folder"] = str(small_disk / "storage")
    cell.write(lights={"kind": "all"})
    ended = cell.acquire()
    assert ended.code == 3
    assert "storage" in ended.err

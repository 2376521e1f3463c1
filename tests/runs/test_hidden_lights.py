"""LEDs that arm, camera or object hide from all that a view sees: marked in the run, or left out of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import pytest
from cells import LOW, TOP, CellFolder, Ended
from expected_pictures import mislabelled

from coupole.motion.occlusion import REACHED

STEEP = {**TOP, "name": "steep", "elevation_deg": 88}


def hidden_in(folder: Path, *, arm_shadows: bool = False, **plan: Any) -> CellFolder:
    """A cell with views in which some LEDs reach nothing: the camera hangs between them and the object. By its
    shading every fifth LED is told from its neighbours only on fine triangles."""
    cell = CellFolder(folder)
    cell.plan_data["object"]["mesh"] = str(cells.RELIEF)
    cell.world_settings["arm_shadows"] = arm_shadows
    cell.write(views=[STEEP, LOW], lights={"kind": "every", "every": 5}, **plan)
    return cell


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellFolder, Ended]:
    """A run whose plan says nothing of hidden LEDs, in a world whose arm blocks light."""
    hidden = hidden_in(tmp_path_factory.mktemp("marked"), arm_shadows=True)
    return hidden, hidden.acquire()


def test_hidden_leds_are_marked_in_journal_and_views_and_taken_where_the_plan_says_nothing(
    marked: tuple[CellFolder, Ended],
) -> None:
    hidden, ended = marked
    assert ended.code == 0
    assert ended.document["shots"] == 2 * 216
    views = {event["view"]: event["hidden_leds"] for event in cells.events(hidden.run_folder, "view")}
    with h5py.File(hidden.run_folder / "views" / "steep.h5") as file:
        shadow = file["entry/shadow"]
        assert shadow.attrs["NX_class"] == "NXcollection"
        codes, seen, leds = shadow["codes"][()], shadow["seen"][()], shadow["leds"][()]
        assert codes.shape == (len(shadow["points_mm"]), 1080) == (len(seen), len(leds))
        assert shadow["normals"].shape == shadow["points_mm"].shape
    assert 0.2 < np.mean(codes[seen] == REACHED) < 1.0
    assert views["steep"] == leds[~(codes[seen] == REACHED).any(axis=0)].tolist()


def test_hidden_leds_are_left_out_as_preflight_says_where_the_plan_says_so(tmp_path: Path) -> None:
    hidden = hidden_in(tmp_path, hidden_lights="skip")
    checked = cells.here("check", hidden.plan, "--json").document
    assert checked["shots"] + checked["hidden_lights"] == 2 * 216
    ended = hidden.acquire()
    assert ended.code == 0, ended.err
    run = hidden.run_folder
    skipped = {(view, led) for view, leds in cells.about(run)["hidden_leds"].items() for led in leds}
    asked = {(view, led) for view in ("steep", "low") for led in range(0, 1080, 5)}
    taken = {
        (shot.split("/")[0], int(frame.record["led"]))
        for shot, frame in cells.stored(run).items()
        if cells.is_light(shot)
    }
    assert skipped & asked
    assert taken == asked - skipped
    assert ended.document["shots"] == len(taken) == checked["shots"]
    assert cells.here("verify", run).code == 0
    assert mislabelled(hidden, run) == []


def test_a_run_is_resumed_without_what_it_began_without(cell: CellFolder) -> None:
    cell.write(views=[STEEP, LOW], hidden_lights="skip")
    cell.faults({"kind": "unplug_camera", "at_edge": 70})
    assert cell.acquire().code == 4
    run = cell.run_folder
    before = cells.about(run)["hidden_leds"]
    assert before["steep"]
    resumed = cell.acquire("--resume", run)  # the rest has fewer edges than 70
    assert resumed.code == 0, resumed.err
    assert cells.about(run)["hidden_leds"] == before
    assert cells.here("verify", run).code == 0


def test_an_led_that_preflight_calls_hidden_gives_a_dark_frame(marked: tuple[CellFolder, Ended]) -> None:
    assert_hidden_leds_give_dark_frames(marked[0].run_folder)


@pytest.mark.full
def test_an_led_that_preflight_calls_hidden_by_a_ur_gives_a_dark_frame(tmp_path: Path) -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde is an optional extra")
    cell = CellFolder(tmp_path, speed=1.0)
    cell.moved_by_ur("ur10e")
    cell.world_settings["arm_shadows"] = True
    cell.write(views=[STEEP], lights={"kind": "every", "every": 5})
    assert cell.acquire().code == 0
    assert_hidden_leds_give_dark_frames(cell.run_folder)


def assert_hidden_leds_give_dark_frames(run: Path) -> None:
    """The world's arm and the controller's are two pictures of one thing: where the controller finds that an LED
    reaches nothing of what is seen, the simulated frame has hardly any light."""
    hidden = set(next(event for event in cells.events(run, "view") if event["view"] == "steep")["hidden_leds"])
    means = {
        int(frame.record["led"]): float(frame.pixels.mean()) - cells.BLACK_DN
        for shot, frame in cells.stored(run).items()
        if cells.is_light(shot) and shot.startswith("steep/")
    }
    dark = [mean for led, mean in means.items() if led in hidden]
    lit = [mean for led, mean in means.items() if led not in hidden]
    assert dark
    assert np.median(dark) < 0.1 * np.median(lit)

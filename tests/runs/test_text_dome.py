"""A dome that somebody built: a box of text lines, no trigger cable, one light, one exposure, one frame."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import pytest
from busy_machine import slowness
from cells import SIDE, TOP, CellFolder, Ended
from expected_pictures import mislabelled
from text_cells import text_cell

PROOF = "one light, one exposure, one frame; host's clock"


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    return text_cell(tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellFolder, Ended]:
    """A run that went well."""
    cell = text_cell(tmp_path_factory.mktemp("text"), views=[TOP, SIDE])
    return cell, cell.acquire()


# -- a run that goes well -------------------------------------------------------------------------------------


def test_the_plan_that_is_shipped_is_run_to_completeness(tmp_path: Path) -> None:
    """In a world as slow as the machine is busy."""
    configs, rig = cells.REPO / "configs", tmp_path / "rig.yaml"
    words = (configs / "rigs/sim-text-dome.yaml").read_text()
    words = words.replace("../../runs", str(tmp_path)).replace("../domes", str(configs / "domes"))
    rig.write_text(words.replace("settings: {seed: 1,", f"settings: {{speed: {0.5 / slowness()}, seed: 1,"))
    assert "speed: 0." in rig.read_text()
    ended = cells.here(
        "acquire", configs / "plans/text-dome.yaml", "--rig", rig, "--json", "--yes", "--output", tmp_path
    )
    assert ended.code == 0, ended.err
    assert (ended.document["shots"], ended.document["proven"], ended.document["frames"]) == (64, 64, 68)


def test_every_frame_is_proven_once(done: tuple[CellFolder, Ended]) -> None:
    cell, ended = done
    assert ended.code == 0, ended.err
    assert (ended.document["shots"], ended.document["proven"]) == (16, 16)  # a busy host may shoot some again
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_every_frame_shows_the_light_of_its_led(done: tuple[CellFolder, Ended]) -> None:
    cell, _ = done
    assert mislabelled(cell, cell.run_folder) == []


def test_the_run_says_wherever_it_is_asked_that_its_proof_is_of_the_weaker_kind(
    done: tuple[CellFolder, Ended],
) -> None:
    run = done[0].run_folder
    assert cells.about(run)["proof"] == PROOF
    with h5py.File(run / "views/top.h5", "r") as file:
        assert file["entry"].attrs["proof"] == PROOF
    assert cells.here("status", run, "--json").document["proof"] == PROOF
    assert cells.here("verify", run, "--json").document["proof"] == PROOF
    assert "one light, one exposure, one frame; host&#39;s clock" in (run / "report.html").read_text()
    for what in ("status", "verify"):
        said = cells.here(what, run)
        assert PROOF in re.sub(r"\s+", " ", said.out + said.err), what


def test_what_the_box_cannot_know_is_not_made_up(done: tuple[CellFolder, Ended]) -> None:
    run = done[0].run_folder
    records = [frame.record for frame in cells.stored(run).values()]
    assert {int(record["board_temperature_dc"]) for record in records} == {0}
    assert {int(record["led_current_ma"]) for record in records} == {0}
    assert {event["hottest_board_c"] for event in cells.events(run, "burst")} == {None}
    assert cells.events(run, "start")[0]["room_c"] is None


def test_triggers_are_timed_on_the_hosts_clock(done: tuple[CellFolder, Ended]) -> None:
    frames = sorted(cells.stored(done[0].run_folder).values(), key=lambda frame: frame.record["camera_ns"])
    triggers_ns = np.array([int(frame.record["t_trigger_ns"]) for frame in frames])
    camera_ns = np.array([int(frame.record["camera_ns"]) for frame in frames])
    assert np.diff(triggers_ns).min() > 20_000_000  # late ones are followed sooner on a busy machine
    assert np.ptp(camera_ns - triggers_ns) < 70e6, "a frame is proven only within its light, of 70 ms"


def test_the_light_given_is_what_the_lamps_really_shone(done: tuple[CellFolder, Ended]) -> None:
    (burst, *_) = cells.events(done[0].run_folder, "burst")
    assert 8 * 0.009 < burst["on_s"] < 8 * 0.2


def test_marks_stand_at_both_ends_of_a_burst_and_darks_come_after_them(done: tuple[CellFolder, Ended]) -> None:
    labels = cells.labels(done[0].run_folder)
    assert (labels[0], labels[1], labels[2], labels[-1]) == ("dark0/e0", "dark2/e0", "dark3/e0", "dark1/e0")


@pytest.mark.parametrize("reply", [None, ""])
def test_a_box_that_confirms_nothing_is_refused(cell: CellFolder, reply: str | None) -> None:
    """Nothing would prove which LED shone: a box that lags would have its frames mislabelled."""
    cell.rig_data["ledbox"]["settings"]["expected_reply"] = reply
    cell.write()
    ended = cell.acquire()
    assert ended.code == 2
    assert "ledbox.settings.expected_reply: " in ended.err


def test_a_dry_run_rehearses_with_the_same_kind_of_box(cell: CellFolder) -> None:
    cell.rig_data["ledbox"]["settings"]["port"] = "/dev/ttyNOPE"
    cell.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    cell.rig_data["robot"]["settings"] = {"listen": "192.0.2.1:49152", "controller": "192.0.2.7"}
    cell.rig_data["world"] = {"serves": "dry_run"}
    cell.write()
    ended = cell.acquire("--dry-run", "--speed", str(cell.speed))
    assert ended.code == 0, ended.err
    assert ended.document["proven"] == 8


def test_the_box_is_named_by_the_devices_command() -> None:
    ended = cells.here("devices", "--rig", cells.REPO / "configs/rigs/sim-text-dome.yaml", "--json")
    assert ended.code == 0, ended.err
    assert ended.document["ledbox"]["serial"] == "SIM-0002"
    assert ended.document["ledbox"]["self_test"] == {
        "LEDs": "64",
        "confirms": "with `OK`",
        "enabling switch": "no input for one",
    }


# -- what goes wrong ------------------------------------------------------------------------------------------


def test_two_leds_whose_wires_are_swapped_are_seen_in_their_pictures(cell: CellFolder) -> None:
    """The identity test above can fail: no proof by clocks tells that an LED is another one."""
    cell.world_settings["dome"] = {"swapped": [[9, 41]]}
    cell.write()
    assert cell.acquire().code == 0
    wrong = mislabelled(cell, cell.run_folder)
    assert sorted(wrong) == ["top/led0009/e0 shows LED 41", "top/led0041/e0 shows LED 9"]


def test_a_lamp_that_does_not_go_out_leaves_its_burst_unproven(cell: CellFolder) -> None:
    cell.faults({"kind": "stuck_led", "led": 26})
    ended = cell.acquire()
    assert ended.code == 5, ended.err
    assert (ended.document["proven"], ended.document["missing"]) == (0, 8)
    assert cells.stored(cell.run_folder) == {}
    reasons = {event["reason"] for event in cells.events(cell.run_folder, "gap")}
    assert all("a dark mark shows light" in reason for reason in reasons)


def test_a_lamp_that_shone_before_the_run_is_seen_at_the_first_mark(cell: CellFolder) -> None:
    cell.join()
    with cell.world({"kind": "stuck_led", "led": 26}) as world:
        with Path(world.endpoints["ledbox"]["port"]).open("wb", buffering=0) as port:
            port.write(b"LED 27 ON\n")
        cells.wait_until(lambda: world.ask("state")["shining"] == [26], "the light")
        ended = cell.acquire()
    assert ended.code == 5, ended.err
    assert cells.stored(cell.run_folder) == {}


def test_a_frame_that_is_lost_is_taken_again(cell: CellFolder) -> None:
    cell.faults({"kind": "lost_transfer", "frame": 5})
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] >= 1  # more on a busy host
    assert mislabelled(cell, cell.run_folder) == []


def test_without_its_last_mark_a_burst_is_not_proven(tmp_path: Path) -> None:
    cell = text_cell(tmp_path, reshoot_limit=0)
    cell.faults({"kind": "lost_transfer", "frame": 11})
    ended = cell.acquire()
    assert ended.code == 5, ended.err
    assert ended.document["proven"] == 0
    assert [event["reason"] for event in cells.events(cell.run_folder, "gap")] == ["a dark mark was not seen"]


@pytest.mark.parametrize("fault", ["mute_box", pytest.param("cut_wire", marks=pytest.mark.full)])
def test_a_box_that_is_lost_ends_the_run_with_four_and_names_it(cell: CellFolder, fault: str) -> None:
    cell.speed = 1.0  # its time-out must come before the session's, on the machine's clock
    cell.join()
    with cell.world() as world:
        process = cell.start_acquire()
        cells.wait_until(lambda: world.ask("state")["shining"], "the first light")
        world.ask("fault", fault={"kind": fault})
        ended = cells.finish(process)
        assert ended.code == 4, ended.err
        assert "led box: expected an answer to `" in ended.err
        cells.wait_until(lambda: cells.safe(world), "darkness: the box itself ends the light")
    *_, burst = cells.events(cell.run_folder, "burst")
    assert burst["on_s"] > 0.009  # the light that the box no longer reported is counted


def test_a_plan_that_wants_a_trigger_cable_is_refused_with_what_to_do(tmp_path: Path) -> None:
    cell = text_cell(tmp_path, trigger="hardware")
    ended = cell.acquire()
    assert ended.code == 3
    assert "cannot trigger the camera: it runs no tables. Set `trigger: software` in the plan" in ended.err


def test_a_driver_that_does_not_say_what_its_box_can_do_is_refused(cell: CellFolder) -> None:
    """Whose box it is cannot be told from its methods."""
    cell.rig_data["ledbox"] = {
        "driver": "sim.devices.memory_camera:MemoryCamera",
        "settings": {"address": "/here"},
    }
    cell.write()
    ended = cell.acquire()
    assert ended.code == 2
    assert "expected a class that declares `runs_tables`" in ended.err


def test_panels_that_the_box_does_not_have_end_the_run_with_four(tmp_path: Path) -> None:
    cell = text_cell(tmp_path, lights={"kind": "panels", "panels": [1]})
    ended = cell.acquire()
    assert ended.code == 4
    assert "panel 1 was requested, but the box has none" in ended.err


def test_a_template_that_lacks_its_led_is_refused_where_it_stands(cell: CellFolder) -> None:
    cell.rig_data["ledbox"]["settings"]["on"] = "LIGHT"
    cell.write()
    ended = cell.acquire()
    assert ended.code == 2
    assert "ledbox.settings" in ended.err
    assert "it lacks {led}" in ended.err


@pytest.mark.parametrize("fault", [{"kind": "drop_trigger", "edge": 3}, {"kind": "mute_box", "at_edge": 3}])
def test_a_fault_that_this_box_cannot_have_is_refused(cell: CellFolder, fault: dict[str, Any]) -> None:
    cell.faults(fault)
    ended = cell.acquire()
    assert ended.code == 2
    assert "LED box of kind `text`" in ended.err


def test_a_run_that_was_killed_is_resumed(tmp_path: Path) -> None:
    cell = text_cell(tmp_path, views=[TOP, SIDE])
    cell.join()
    with cell.world() as world:
        process = cell.start_acquire()
        run = cell.run_folder
        cells.wait_until(lambda: cells.frame_lines(run) >= 12, "the first view")
        cells.wait_until(lambda: world.ask("state")["shining"], "a light of the second view")
        process.kill()
        cells.finish(process)
        cells.wait_until(lambda: not world.ask("state")["shining"], "darkness: the box itself ends the light")
        before = {event["shot"] for event in cells.events(run, "frame")}
        ended = cell.acquire("--resume", run)
    assert ended.code == 0, ended.err
    assert len(before) == 12
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(cell, run) == []

"""Whole runs with the camera on the wire: real GigE Vision packets through Aravis, and what gets lost on them."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder
from expected_pictures import mislabelled
from gige import gige_port, needs_aravis
from ruamel.yaml import YAML

from sim.world.client import World

pytestmark = needs_aravis


@pytest.fixture
def gige(tmp_path: Path, scale: Callable[[int, int], int]) -> Iterator[CellFolder]:
    """A small cell in real time with the camera of `sim-gige.yaml`; at full scale all lights at 1024 x 768."""
    shipped = cells.shipped_rig("sim-gige")
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["camera"] = shipped["camera"]
    if scale(0, 1):
        cell.rig_data["sensor"] = shipped["sensor"]
        cell.plan_data["lights"] = {"kind": "all"}
    cell.write()
    with gige_port():
        yield cell


def assert_proven_and_labelled(cell: CellFolder) -> None:
    """Each shot once; on small frames, that each shows its own light (on large ones that takes minutes)."""
    cells.assert_each_shot_proven_once(cell.run_folder)
    if cell.rig_data["sensor"]["width_px"] <= 128:
        assert mislabelled(cell, cell.run_folder) == []


def camera_counts(run: Path) -> dict[str, int]:
    """The camera's own figures, over all bursts."""
    bursts = [event["camera"] for event in cells.events(run, "burst")]
    return {name: sum(burst[name] for burst in bursts) for name in bursts[0]}


def test_a_run_over_gige_vision_proves_every_shot(gige: CellFolder) -> None:
    ended = gige.acquire()
    assert ended.code == 0, ended.err
    assert_proven_and_labelled(gige)
    camera = cells.about(gige.run_folder)["devices"]["camera"]
    assert camera["model"] == "DomeCamera"
    assert (camera["settings"]["TriggerDelay"], camera["settings"]["ReverseX"]) == ("0.0", "False")


def test_packets_frames_and_edges_that_get_lost_are_found_and_taken_again(
    gige: CellFolder, scale: Callable[[int, int], int]
) -> None:
    """At full scale 0.05 % of packets, which is 2.4 % of frames; a small frame is but three packets."""
    gige.world_settings["camera"] = {"lost_packets": scale(500, 50) / 100_000}
    gige.faults(
        {"kind": "lost_transfer", "frame": 20},
        {"kind": "lost_transfer", "frame": 21},
        {"kind": "drop_trigger", "edge": 30},
        {"kind": "double_trigger", "edge": 35, "delay_us": 3_000},
        {"kind": "double_trigger", "edge": 40, "delay_us": 3_000},
    )
    ended = gige.acquire()
    assert ended.code == 0, ended.err
    assert_proven_and_labelled(gige)
    assert ended.document["reshot"] >= 3
    counts = camera_counts(gige.run_folder)
    assert counts["over_triggers"] == 2
    assert counts["lost_transfers"] >= 2


def test_a_camera_that_forgets_its_client_in_a_burst_ends_the_run_with_four_and_it_can_be_resumed(
    gige: CellFolder,
) -> None:
    with gige.world({"kind": "camera_control_loss", "at_edge": 30}) as world:
        gige.join()
        ended = gige.acquire()
        assert ended.code == 4
        assert "camera: expected control of the camera" in ended.err
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
        assert not world.ask("state")["shining"]
        run = gige.run_folder
        left = len(cells.labels(run)) - cells.frame_lines(run)
        assert left > 0
        resumed = gige.acquire("--resume", run)
    assert resumed.code == 0, resumed.err
    cells.assert_each_shot_proven_once(run)


def test_a_camera_whose_process_dies_in_a_burst_is_a_fault_of_the_camera_alone(gige: CellFolder) -> None:
    gige.write(lights={"kind": "every", "every": 4})
    with gige.world() as world:
        gige.join()
        (camera,) = cells.children(world.endpoints["pid"])
        killing = threading.Thread(target=_kill_while_armed, args=(world, camera))
        killing.start()
        ended = gige.acquire()
        killing.join()
        assert ended.code == 4, ended
        assert "camera: expected " in ended.err
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
        assert world.ask("state")["t_s"] > 0


def _kill_while_armed(world: World, pid: int) -> None:
    cells.wait_until(lambda: world.ask("state")["camera_armed"], "a burst")
    os.kill(pid, signal.SIGKILL)


@pytest.mark.skipif(shutil.which("arv-tool-0.8") is None, reason="arv-tool-0.8 is not installed")
def test_an_independent_client_finds_the_camera_of_coupole_sim(gige: CellFolder) -> None:
    serving = cells.start("sim", gige.rig, stdin=subprocess.PIPE)
    assert serving.stdout is not None
    try:
        assert '"kind": "gige"' in serving.stdout.readline()
        command = [
            "arv-tool-0.8",
            "-a",
            "127.0.0.1",
            "control",
            "DeviceSerialNumber",
            "SensorWidth",
            "PixelFormat",
        ]
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    finally:
        serving.terminate()
        cells.finish(serving)
    assert "DeviceSerialNumber = 'SIM-1'" in said or re.search(r"DeviceSerialNumber = SIM-1", said)
    assert f"SensorWidth = {gige.rig_data['sensor']['width_px']}" in said


def test_a_rehearsal_of_the_shipped_rig_needs_no_network(tmp_path: Path) -> None:
    """Its twin is the camera in shared memory."""
    plan: dict[str, Any] = {
        **CellFolder(tmp_path).plan_data,
        "rig": str(cells.REPO / "configs/rigs/sim-gige.yaml"),
    }
    path = tmp_path / "rehearsal.yaml"
    YAML(typ="safe", pure=True).dump(plan, path)
    ended = cells.here("acquire", path, "--json", "--dry-run", "--speed", "20")
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0


def test_a_rig_with_another_camera_in_its_world_than_on_its_wire_is_refused(gige: CellFolder) -> None:
    gige.world_settings["camera"] = {"kind": "memory"}
    gige.write()
    ended = cells.here("check", gige.plan, "--json")
    assert ended.code == 2
    assert "gige" in ended.err

"""A bench's work ends with the process that asked for it, on the simulated cell, over its wires."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import cells
import numpy as np
import psutil
import pytest
from benches import HERE, Bench, begun, bench, holding
from cells import CellFolder

from sim.world.client import World

PARK_DEG = [60.0, -170.0, 150.0, 0.0, -70.0, 0.0]
ASKS_AND_STAYS = """
import json, socket, sys, time
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(sys.argv[1])
    connection.sendall(sys.argv[2].encode() + b"\\n")
    print(connection.makefile().readline(), flush=True)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    found = CellFolder(tmp_path_factory.mktemp("bench"), speed=1.0)
    found.rig_data["motion"]["park_joints_deg"] = PARK_DEG
    found.rig_data["ledbox"]["settings"]["watchdog_s"] = 2.0
    found.join()
    return found


@pytest.fixture(scope="module")
def world(cell: CellFolder) -> Iterator[World]:
    with cell.world() as found:
        yield found


def turned_deg(world: World) -> float:
    return float(world.ask("state")["joints_deg"][0])


def at_rest(world: World) -> dict[str, Any]:
    found: dict[str, Any] = cells.wait_until(
        lambda: not (state := world.ask("state"))["arm_moving"] and state, "the arm at rest"
    )
    return found


@pytest.mark.parametrize("end", [signal.SIGSTOP, signal.SIGKILL])
def test_the_arm_stops_with_the_process_that_asked_for_the_motion(
    cell: CellFolder, world: World, end: signal.Signals
) -> None:
    """As after Ctrl-Z: whoever sees `Stopped` at the terminal believes that the arm does not move."""
    with bench(cell.rig, "--object", cell.plan) as asked:
        asked.drive("home")
        client = cells.start("arm", cell.rig, "park", "--yes")
        cells.wait_until(lambda: turned_deg(world) > 5.0, "the arm under way")
        client.send_signal(end)
        work = asked.ended_work()
        why = "has ended" if end == signal.SIGKILL else "was stopped (Ctrl-Z, SIGSTOP)"
        assert (work["state"], work["why"]) == ("stopped", f"process {client.pid}, which asked for it, {why}")
        at_rest_deg = at_rest(world)["joints_deg"]
        assert at_rest_deg[0] < 50.0, "of the 60 to park"
        client.send_signal(signal.SIGCONT)
        told = cells.finish(client)
        assert np.allclose(at_rest(world)["joints_deg"], at_rest_deg, atol=0.01), "the arm went on"
        assert asked.done("state")["arm"]["faults_to_confirm"] == []
    assert told.code == (-signal.SIGKILL if end == signal.SIGKILL else 4), told
    assert end == signal.SIGKILL or "which asked for it, was stopped" in " ".join(told.err.split())


def test_a_metering_ends_with_the_process_that_asked_for_it_and_the_bench_with_it(
    cell: CellFolder, world: World
) -> None:
    asked = begun(cell.rig, "--object", cell.plan)
    request = json.dumps({"version": 1, "command": "meter", "plan": str(cell.plan)})
    client = subprocess.Popen(
        [sys.executable, "-c", ASKS_AND_STAYS, str(asked.path), request], stdout=subprocess.PIPE, text=True
    )
    with client:
        assert client.stdout is not None
        assert json.loads(client.stdout.readline())["state"] == "running"
        cells.wait_until(lambda: world.ask("state")["arm_moving"], "the arm on its way to the view")
        client.kill()
    assert cells.finish(asked.process).code == 4
    assert cells.safe(world)
    at_rest_deg = at_rest(world)["joints_deg"]
    assert at_rest(world)["joints_deg"] == at_rest_deg


def test_many_refused_requests_leave_no_file_open(cell: CellFolder, world: World) -> None:
    with bench(cell.rig) as asked:
        before = open_files(asked)
        for _ in range(50):
            assert "error" in asked.ask("drive", path="77")
        assert open_files(asked) <= before + 5


def open_files(asked: Bench) -> int:
    return psutil.Process(asked.process.pid).num_fds()


def test_a_motion_by_hand_stops_with_a_console_that_is_frozen(cell: CellFolder, world: World) -> None:
    """Also where another process has guessed its hold and would renew it."""
    with bench(cell.rig, "--object", cell.plan) as asked:
        asked.drive("home")
        with holding(asked, "A1", 1, share=1.0) as console:
            cells.wait_until(lambda: turned_deg(world) > 1.0, "the arm under way")
            console.send_signal(signal.SIGSTOP)
            frozen_s = time.monotonic()
            work = asked.ended_work()
            print(f"ended {time.monotonic() - frozen_s:.3f} s after the freeze")
            why = f"process {console.pid}, which asked for it, was stopped (Ctrl-Z, SIGSTOP)"
            assert (work["state"], work["why"]) == ("stopped", why)
        asked.drive("home")


@pytest.mark.parametrize("killed", [False, True])
def test_a_button_is_held_only_by_the_process_that_pressed_it(
    cell: CellFolder, world: World, *, killed: bool
) -> None:
    with bench(cell.rig, "--object", cell.plan) as asked:
        asked.drive("home")
        request = {"version": 1, "command": "jog", "axis": "A1", "direction": 1, "from": HERE}
        line = [sys.executable, "-c", ASKS_AND_STAYS, str(asked.path), json.dumps(request)]
        with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as console:
            assert console.stdout is not None
            hold = json.loads(console.stdout.readline())["hold"]
            if killed:
                console.kill()
                console.wait()
            refused = asked.ask("jog", axis="A1", direction=1, hold=hold, **{"from": HERE})
            console.kill()
        assert f"hold: {hold} is held by another process" in refused["error"]
        assert refused["exit_code"] == 2
        work = asked.ended_work()
        for _ in range(10):
            assert "error" in asked.ask("jog", axis="A1", direction=1, hold=hold, **{"from": HERE})
        if killed or "ended" not in work:  # on a busy machine, nobody may have renewed it in time
            assert work["state"] in ("stopped", "done")
        else:
            assert work["ended"] == "another process renewed it"
        at_rest_deg = at_rest(world)["joints_deg"]
        time.sleep(0.3)
        assert np.allclose(at_rest(world)["joints_deg"], at_rest_deg, atol=0.01)


def test_while_a_button_is_held_no_drive_is_shown_or_begun_or_kept_for_later(
    cell: CellFolder, world: World
) -> None:
    with bench(cell.rig, "--object", cell.plan) as asked:
        asked.drive("home")
        to_park = asked.done("plan_path", to="park")
        with holding(asked, "A1", 1) as console:
            cells.wait_until(lambda: turned_deg(world) > 1.0, "the arm under way")
            assert "error" in asked.ask("drive", path=to_park["path"])
            cells.wait_until(
                lambda: asked.ask("plan_path", to="park").get("error", "").startswith("jog is under way"),
                "a refusal, also while the arm rests between steps",
            )
            console.kill()
        assert asked.ended_work()["kind"] == "jog"
        time.sleep(0.5)
        assert not world.ask("state")["arm_moving"]


@pytest.mark.parametrize("plan", ["/tmp/a\0b", "/tmp/" + 5000 * "a", "relative.yaml", "/proc/self/mem"])
def test_a_plan_whose_name_is_none_is_bad_input(cell: CellFolder, world: World, plan: str) -> None:
    with bench(cell.rig) as asked:
        for request in (
            {"command": "meter", "plan": plan},
            {"command": "plan_path", "to": {"view": "top", "plan": plan}},
        ):
            answer = asked.ask(**request)
            assert (answer["kind"], answer["exit_code"]) == ("InputError", 2), answer

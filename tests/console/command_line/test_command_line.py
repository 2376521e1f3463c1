"""The command line where a console owns the cell: it acquires by it, borrows the cell, and tells it of light."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from at_a_terminal import at_a_terminal
from cells import CellFolder
from served import BORROWER, Browser, Served, served

from coupole.acquisition import runtime_folder
from coupole.acquisition.cell_bench.bench_client import ask_bench
from coupole.console.command_line.client import borrowed_cell, call, is_served
from coupole.errors import InputError
from coupole.plan.cell import read_cell
from sim.world.client import World


class Standing:
    """A cell whose world outlives its controllers, its console, and an engineer at its page."""

    def __init__(self, cell: CellFolder, world: World, service: Served) -> None:
        self.cell, self.world, self.service = cell, world, service
        self.engineer: Browser = service.browser(token=service.token)

    def state(self) -> dict[str, Any]:
        return self.engineer.state()

    @contextmanager
    def when_frames_are_proven(self, act: Callable[[], None]) -> Iterator[None]:
        """Do something in another thread as soon as this session has proven more frames than a burst that goes on
        takes anew, which are its dark ones."""
        enough = self.state()["proven"] + 10
        done: list[bool] = []

        def wait() -> None:
            cells.wait_until(lambda: self.state()["proven"] >= enough, "proven frames")
            act()
            done.append(True)

        thread = threading.Thread(target=wait)
        thread.start()
        try:
            yield
        finally:
            thread.join()
        assert done


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Standing]:
    cell = CellFolder(tmp_path_factory.mktemp("standing"), speed=2.0)
    cell.join()
    cell.write(lights=cells.SOME_LIGHTS, repeats=20)
    with cell.world() as world, served(cell) as service:
        yield Standing(cell, world, service)


@pytest.fixture(autouse=True)
def nobody_in_control(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    if "standing" in request.fixturenames:
        engineer: Browser = request.getfixturevalue("standing").engineer
        engineer.post("/api/v1/control/take")
        assert engineer.post("/api/v1/control/give", {}).status == 200


def test_a_run_of_a_terminal_is_the_consoles_and_is_stopped_resumed_killed_and_offered_again(
    standing: Standing,
) -> None:
    cell, world = standing.cell, standing.world
    with standing.when_frames_are_proven(lambda: os.kill(os.getpid(), signal.SIGTERM)):
        stopped = cells.here("acquire", cell.plan, "--json", "--yes")
    run = cell.run_folder
    assert (stopped.code, stopped.document["kind"], stopped.document["run"]) == (143, "Interrupted", str(run))
    assert cells.safe(world)
    entry = standing.state()["queue"][-1]
    assert (entry["exit_code"], entry["by"].endswith("(command line)")) == (130, True)
    said: list[str] = []
    served_cell = read_cell(cell.rig)

    def refused_then_killed() -> None:
        for path, asked in (("queue", {"plan": str(cell.plan), "now": True}), ("cell/lease", {"what": "live"})):
            with pytest.raises(InputError) as refused:
                call(served_cell, "POST", f"/api/v1/{path}", asked)
            said.append(str(refused.value))
        os.kill(standing.state()["queue"][-1]["pid"], signal.SIGKILL)

    with standing.when_frames_are_proven(refused_then_killed):
        killed = cells.here("acquire", "--resume", run, "--yes")
    assert killed.code == 4, killed.err
    assert "view top (1/1)" in killed.err
    assert f"--resume {run}" in killed.err
    assert said == [f"{run.name} is being acquired", f"live: {run.name} is being acquired"]
    cells.wait_until(lambda: cells.safe(world), "the devices' own watchdogs")
    state = standing.state()
    assert (state["state"], state["run"], state["queue"][-1]["state"]) == ("halted", None, "failed")
    assert "its process was killed" in state["halted"]

    again = standing.engineer.post("/api/v1/queue", {"resume": run.name}).document
    left = cells.here("status", run, "--json").document
    assert left["go_on"]
    whole = cells.about(run)["expected"]["frames"]
    assert whole - cells.frame_lines(run) <= again["needs"]["frames"] < whole
    assert standing.engineer.post(f"/api/v1/queue/{again['id']}", method="DELETE").status == 200


def test_a_run_whose_console_is_killed_goes_on_which_is_said_and_ctrl_c_stops_it_still(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=2.0)
    cell.join()
    cell.write(lights=cells.SOME_LIGHTS, repeats=40)
    with cell.world() as world, served(cell) as service:
        follower = cells.start("acquire", cell.plan, "--yes")
        run = cell.run_folder
        cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
        service.process.kill()
        service.process.wait()
        time.sleep(1.0)
        follower.send_signal(signal.SIGINT)
        ended = cells.finish(follower)
        assert (ended.code, "the run GOES ON" in ended.err) == (130, True), ended.err
        assert f"coupole stop {run}" in ended.err
        cells.wait_until(lambda: cells.events(run, "stop"), "the run's end")
        assert cells.safe(world)
    assert cells.events(run, "stop")[-1]["outcome"] == "interrupted"


def test_a_run_whose_console_is_frozen_is_stopped_by_ctrl_c_all_the_same(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=2.0)
    cell.join()
    cell.write(lights=cells.SOME_LIGHTS, repeats=200)
    with cell.world() as world, served(cell) as service:
        follower = cells.start("acquire", cell.plan, "--yes")
        run = cell.run_folder
        cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
        service.process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(2.5)  # until it is told
            follower.send_signal(signal.SIGINT)
            ended = cells.finish(follower)
            cells.wait_until(lambda: cells.events(run, "stop"), "the run's end")
            assert cells.safe(world)
        finally:
            service.process.send_signal(signal.SIGCONT)
    assert (ended.code, "the run GOES ON" in ended.err) == (130, True), ended.err
    assert cells.events(run, "stop")[-1]["outcome"] == "interrupted"


def test_a_terminal_that_stands_still_stops_no_run_but_ctrl_z_does_and_says_so_when_it_has(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["motion"] |= {"speed_fraction": 0.1}
    cell.join()
    cell.write(views=[cells.TOP, cells.SIDE], lights=cells.SOME_LIGHTS)
    with cell.world() as world, served(cell):
        follower = cells.start("acquire", cell.plan, "--yes", anew=True)
        cells.wait_until(lambda: world.ask("state")["arm_moving"], "a motion")
        follower.send_signal(signal.SIGSTOP)
        time.sleep(1.5)
        follower.send_signal(signal.SIGCONT)
        time.sleep(1.0)
        assert not cells.events(cell.run_folder, "stop"), "the run has a process of its own"
        cells.wait_until(lambda: world.ask("state")["arm_moving"], "a motion")
        follower.send_signal(signal.SIGTSTP)
        assert follower.stderr is not None
        line = next(line for line in follower.stderr if "suspended" in line)
        joints_deg = world.ask("state")["joints_deg"]
        time.sleep(0.5)
        state = world.ask("state")
        assert np.allclose(state["joints_deg"], joints_deg, atol=0.01), line
        assert not state["shining"]
        assert "lights are off, the arm is at rest" in line
        follower.send_signal(signal.SIGCONT)
        assert cells.finish(follower).code == 130


def test_the_cell_is_lent_to_a_process_until_that_ends(standing: Standing) -> None:
    command = [sys.executable, "-c", BORROWER, str(standing.cell.rig)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=cells.REPO) as borrower:
        assert borrower.stdout is not None
        assert borrower.stdout.readline() == "mine\n"
        lent_to = standing.state()["lent_to"]
        assert lent_to.endswith("(command line): look at the focus")
        for what, *named in (
            ("live", standing.cell.rig),
            ("meter", standing.cell.plan),
            ("devices", "--rig", standing.cell.rig),
            ("commission", standing.cell.rig, "--name", "Ada", "--yes"),
            ("calibrate", "all", "--rig", standing.cell.rig, "--out", standing.cell.folder / "calibrations"),
        ):
            refused = cells.here(what, *named)
            assert (refused.code, f": the cell is lent to {lent_to}" in refused.err) == (2, True), what
        asked = {"plan": str(standing.cell.plan), "now": True}
        assert lent_to in standing.engineer.post("/api/v1/queue", asked | {"plan": "plan.yaml"}).document["detail"]
        with pytest.raises(InputError, match="not lent to this process"):
            call(read_cell(standing.cell.rig), "DELETE", "/api/v1/cell/lease")
        borrower.kill()
    assert standing.state()["lent_to"] == ""
    assert standing.engineer.post("/api/v1/cell/lease", {"what": "mine"}).status == 403


def test_who_is_in_control_at_the_page_is_not_overruled_unasked(standing: Standing) -> None:
    rig = standing.cell.rig
    standing.engineer.post("/api/v1/control/take")
    refused = cells.here("acquire", standing.cell.plan)
    assert (refused.code, "first engineer is in control" in refused.err) == (2, True)
    assert cells.here("queue", rig, "--take-control", "--hold", "lunch", "--give-control").code == 0
    assert standing.state()["in_control"] == ""
    assert cells.here("queue", rig, "--go-on").code == 0
    assert standing.state()["in_control"] == "", "a command is over when it is answered"
    cells.wait_until(lambda: standing.state()["queue"][-1]["state"] == "done", "the hold, which closes a bench")


def test_the_arm_of_an_open_bench_is_not_driven_while_another_is_in_control(standing: Standing) -> None:
    rig, plan, world = standing.cell.rig, standing.cell.plan, standing.world
    bench = cells.start("bench", rig, "--object", plan, "--yes", "--json", stderr=subprocess.DEVNULL)
    assert bench.stdout is not None
    assert bench.stdout.readline()

    def stops() -> int:
        return int(ask_bench(read_cell(rig), "state")["stops"])

    standing.engineer.post("/api/v1/control/take")
    before_deg = np.array(world.ask("state")["joints_deg"])
    refused = cells.here("arm", rig, "home", "--yes")
    assert (refused.code, "first engineer is in control" in refused.err) == (2, True), refused
    assert np.array_equal(before_deg, world.ask("state")["joints_deg"])
    standing.engineer.post("/api/v1/control/give", {})
    with at_a_terminal("arm", rig, "view", plan, "top") as typist:
        typist.waits_for("Drive the arm along this path? [y/N]")
        standing.engineer.post("/api/v1/control/take")
        typist.types("y\n")
        assert typist.process.wait(cells.PATIENCE_S) == 2, "control was taken while the question was open"
        typist.waits_for("first engineer is in control")
    assert stops() == 0, "what is refused does not stop the motion of the person in control"
    standing.engineer.post("/api/v1/control/give", {})
    assert cells.here("arm", rig, "home", "--yes").code == 0
    bench.send_signal(signal.SIGINT)
    assert cells.finish(bench).code == 0
    lines = (standing.cell.folder / "storage/state/console/audit.jsonl").read_text().splitlines()
    asked = [line for line in map(json.loads, lines) if line["asked"] == "POST /api/v1/bench/permission"]
    assert {line["about"] for line in asked} == {"arm to home", "arm to top"}
    assert all(line["name"].endswith("(command line)") for line in asked)
    assert {line["status"] for line in asked} == {409, 200}


def test_the_queue_refuses_with_the_code_that_the_check_has(standing: Standing) -> None:
    far, waiting = standing.cell.folder / "far.yaml", len(standing.state()["queue"])
    plan = standing.cell.plan_data | {"views": [{**cells.TOP, "distance_mm": 2500}]}
    for change, code in (({}, 3), ({"repeats": "often"}, 2)):
        far.write_text(json.dumps(plan | change))
        for ended in (cells.here("queue", standing.cell.rig, far), cells.here("check", far)):
            assert ended.code == code, ended
    assert len(standing.state()["queue"]) == waiting


def test_light_by_hand_goes_through_the_console_whose_log_says_who_and_what(standing: Standing) -> None:
    entered = cells.here(
        "dose", "relief", "--rig", standing.cell.rig, "--add", "0.5", "--note", "studio", "--json"
    )
    assert entered.document["dose_lux_h"] == pytest.approx(0.5)
    light = standing.engineer.get("/api/v1/objects/relief/light").document
    assert light == entered.document
    lines = (standing.cell.folder / "storage/state/console/audit.jsonl").read_text().splitlines()
    (line,) = [line for line in map(json.loads, lines) if line["asked"] == "POST /api/v1/objects/relief/light"]
    assert (line["name"].endswith("(command line)"), line["about"]) == (True, "0.5 lux.h: studio")


def test_where_no_console_is_served_commands_work_by_themselves(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    assert cells.here("dose", "relief", "--rig", cell.rig, "--add", "0.5", "--note", "studio").code == 0
    assert (cell.folder / "ledger/relief.jsonl").is_file()
    asked = cells.here("queue", cell.rig)
    assert (asked.code, "`coupole serve" in asked.err) == (2, True)


def test_a_machine_without_a_place_for_sockets_keeps_nobody_from_working(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = read_cell(CellFolder(tmp_path).rig)
    monkeypatch.setattr(runtime_folder, "_BASE", tmp_path / "nowhere")
    with borrowed_cell(cell, "live"):
        assert not is_served(cell)

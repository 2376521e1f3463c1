"""bluesky's RunEngine takes a view over the real wires, Tiled keeps it; and what is left of a process that is
killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from cells import wait_until
from neighbour_programs import needs_neighbours

import coupole
from coupole.testing import SimulatedCell, started_cell

HERE = Path(__file__).parent
pytestmark = needs_neighbours


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One flight, and what Tiled gives back of it."""
    folder = tmp_path_factory.mktemp("flight")
    with started_cell(folder) as cell:
        ended = subprocess.run(
            [sys.executable, HERE / "fly_a_view.py", cell.rig, folder],
            capture_output=True,
            text=True,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
        found: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
        found["lit"] = sorted(cell.light_given_s())
        found["safe"] = cell.look().is_safe
    return found


def test_each_proven_frame_comes_back_equal_with_its_facts(flown: dict[str, Any]) -> None:
    assert flown["frames"] > 3
    assert (flown["wrong"], flown["beside"]) == ([], [])
    assert flown["shape"][1:] == [384, 512]


def test_the_lights_and_the_exposure_are_those_of_the_signals(flown: dict[str, Any]) -> None:
    assert sorted(flown["leds"]) == [0, 20, 420]
    assert flown["lit"] == [0, 20, 420]
    assert flown["configuration"]["cell-exposure_us"] == 4000
    assert flown["configuration"]["cell-run_folder"] == flown["run"]
    assert flown["configuration"]["cell-proof"] == flown["proof"]


def test_the_run_is_a_run_of_ours(flown: dict[str, Any]) -> None:
    with coupole.open_run(flown["run"]) as run:
        assert run.missing == ()
        assert (run.folder / "journal.jsonl").stat().st_size > 0


def test_documents_are_those_of_a_flight(flown: dict[str, Any]) -> None:
    assert flown["documents"][0] == "start"
    assert flown["documents"][-1] == "stop"
    assert {"descriptor", "event_page", "stream_resource", "stream_datum"} <= set(flown["documents"])
    assert (flown["start"], flown["stop"]) == ("one view", "success")


def test_a_view_that_the_plan_lacks_is_refused_with_those_it_has(flown: dict[str, Any]) -> None:
    assert flown["refused"] == "bottom: the plan demo-short has no such view; it has: top"
    assert flown["safe"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_process_that_is_ended_in_a_flight_leaves_the_cell_dark_and_still(
    simulated_cell: SimulatedCell, tmp_path: Path, number: signal.Signals
) -> None:
    process = subprocess.Popen(
        [sys.executable, HERE / "fly_for_long.py", simulated_cell.rig, tmp_path / "out"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: len(simulated_cell.light_given_s()) > 200, "light")
        while process.poll() is None:
            os.kill(process.pid, number)  # bluesky takes one Ctrl-C for a pause after the flight, a second for now
            time.sleep(0.5)
        wait_until(lambda: simulated_cell.look().is_safe, "a cell that is dark and still")
        given_s = simulated_cell.light_given_s()
        time.sleep(2.0)
        assert simulated_cell.look().is_safe
        assert simulated_cell.light_given_s() == given_s
    finally:
        process.kill()
        process.wait()
    (run,) = (tmp_path / "out").iterdir()
    with coupole.open_run(run) as partial:
        assert len(partial["top"]) < 3 * 1080

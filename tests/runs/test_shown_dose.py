"""However a session ends, all who tell of its light say the same, never below the truth."""

from __future__ import annotations

import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder
from real_cells import real_cell, true_dose_lux_h

from coupole.acquisition.arm_supervisor import ArmSupervisor
from coupole.acquisition.recorder import RunRecorder
from coupole.errors import DeviceLost, StorageError
from coupole.storage.ledger import Ledger
from coupole.viewing import terminal
from sim.world.client import World

ROUNDING = 1e-6
QUARTZ = 1e-4
"""The box's seconds are its own quartz's."""
MANY = {"kind": "every", "every": 9}


@contextmanager
def one_view(folder: Path) -> Iterator[tuple[CellFolder, World]]:
    """A cell as a real one, with a burst of 120 LEDs."""
    with real_cell(folder, lights=MANY) as (cell, world):
        yield cell, world


def printed_lux_h(ended: cells.Ended) -> None:
    """Of the line that says how the session ended."""
    found = re.search(r"re-shot, .* ([0-9.]+) lux\.h", ended.err)
    assert found, ended.err
    return float(found[1])


def assert_all_say_the_same(cell: CellFolder, world: World, ended: cells.Ended) -> None:
    """The figures of a session that has ended, and of the run that it leaves."""
    run = cell.run_folder
    ledger = Ledger(Path(cell.rig_data["ledger"]), "relief").read_history().of_run(run.name).total_lux_h
    journal = cells.here("status", run, "--json").document["dose_lux_h"]
    wait_for_the_dark(world)
    true = float(true_dose_lux_h(cell, world).max())
    told = {"ledger": ledger, "journal": journal, "json": ended.document["dose_lux_h"]}
    assert told == {who: pytest.approx(ledger, abs=ROUNDING) for who in told}
    assert printed_lux_h(ended) == pytest.approx(ledger, abs=5e-4 + ROUNDING), "three digits"
    assert reported_lux_h(run) == pytest.approx(ledger, abs=5e-4 + ROUNDING)
    assert 0 < true <= ledger * (1 + QUARTZ)


def reported_lux_h(run: Path) -> float:
    """Of the run's report."""
    found = re.search(r"([0-9.]+) lux h", (run / "report.html").read_text())
    assert found
    return float(found[1])


def wait_for_the_dark(world: World) -> None:
    """A box without its host goes on until its table or its watchdog ends it."""

    def still_dark() -> bool:
        light, begun_s = world.ask("light"), world.ask("state")["t_s"]
        cells.wait_until(lambda: world.ask("state")["t_s"] > begun_s + 0.2, "a moment of the world's time")
        return bool(world.ask("light") == light)

    cells.wait_until(still_dark, "the dark")


def lit(world: World) -> float:
    return float(sum(world.ask("light")["leds_s"].values()))


def in_the_burst(world: World, act: Callable[[], Any]) -> threading.Thread:
    """Do it once some more LEDs were lit."""
    before_s = lit(world)

    def watch() -> None:
        cells.wait_until(lambda: lit(world) > before_s + 0.2, "some light")
        act()

    watching = threading.Thread(target=watch)
    watching.start()
    return watching


@pytest.fixture(autouse=True)
def printed_beside_json(monkeypatch: pytest.MonkeyPatch) -> None:
    """With `--json`, too, all is printed: of one session both can be seen."""
    make_console = terminal.make_console
    monkeypatch.setattr(terminal, "make_console", lambda *, quiet: make_console(quiet=False))


# -- a device fails in a burst -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("device", "kind"),
    [
        ("led box", "cut_wire"),
        pytest.param("led box", "mute_box", marks=pytest.mark.full),
        ("camera", "unplug_camera"),
        pytest.param("robot", "emergency_stop", marks=pytest.mark.full),
    ],
)
def test_after_a_device_was_lost_in_a_burst_all_tell_the_same(tmp_path: Path, device: str, kind: str) -> None:
    with one_view(tmp_path) as (cell, world):
        world.ask("fault", fault={"kind": kind, "at_edge": 41})
        ended = cell.acquire()
        assert (ended.code, ended.document["error"].partition(":")[0]) == (4, device), ended.err
        assert_all_say_the_same(cell, world, ended)


def test_a_burst_whose_frames_cannot_be_released_is_told_as_planned_by_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link to the box is lost, and the disk fails as well: the burst's end is not counted."""

    def fails(*_: Any) -> None:
        raise StorageError("the disk has gone")

    monkeypatch.setattr(RunRecorder, "free", fails)
    with one_view(tmp_path) as (cell, world):
        world.ask("fault", fault={"kind": "cut_wire", "at_edge": 41})
        ended = cell.acquire()
        assert ended.code == 4, ended.err
        assert_all_say_the_same(cell, world, ended)


# -- somebody ends it, and it is resumed --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[CellFolder, World]]:
    """A cell whose world goes on from test to test."""
    with one_view(tmp_path_factory.mktemp("lasting")) as (cell, world):
        yield cell, world


def test_interrupted_killed_and_resumed_all_tell_the_same(lasting: tuple[CellFolder, World]) -> None:
    """And a session that ends before its first light tells that of the earlier ones."""
    cell, world = lasting
    interrupts = in_the_burst(world, lambda: os.kill(os.getpid(), signal.SIGINT))
    ended = cell.acquire()
    interrupts.join()
    assert ended.code == 130, ended.err
    run = cell.run_folder
    assert_all_say_the_same(cell, world, ended)

    killed = cell.start_acquire("--resume", run)
    in_the_burst(world, killed.kill).join()
    cells.finish(killed)
    wait_for_the_dark(world)
    world.ask("reset_robot")
    ledger = Ledger(Path(cell.rig_data["ledger"]), "relief").read_history().of_run(run.name)
    assert ledger.unsettled_lux_h > 0
    status = cells.here("status", run, "--json").document
    assert status["dose_lux_h"] == pytest.approx(ledger.total_lux_h, abs=ROUNDING)
    assert true_dose_lux_h(cell, world).max() <= ledger.total_lux_h * (1 + QUARTZ)
    assert cells.here("report", run).code == 0
    assert reported_lux_h(run) == pytest.approx(ledger.total_lux_h, abs=5e-4 + ROUNDING)

    resumed = cell.acquire("--resume", run)
    assert resumed.code == 0, resumed.err
    assert_all_say_the_same(cell, world, resumed)


def test_a_session_that_ends_before_its_first_light_tells_that_of_the_earlier_ones(
    lasting: tuple[CellFolder, World], monkeypatch: pytest.MonkeyPatch
) -> None:
    cell, world = lasting
    interrupts = in_the_burst(world, lambda: os.kill(os.getpid(), signal.SIGINT))
    ended = cell.acquire("--output", cell.folder / "another")
    interrupts.join()

    def fails(*_: Any) -> None:
        raise DeviceLost("robot", expected="a posture", happened="there was none", remedy="None.")

    monkeypatch.setattr(ArmSupervisor, "itinerary", fails)
    again = cell.acquire("--resume", ended.document["run"])
    cell.confirm()
    assert again.code == 4
    assert again.document["dose_lux_h"] == ended.document["dose_lux_h"] > 0
    assert printed_lux_h(again) == pytest.approx(ended.document["dose_lux_h"], abs=5e-4)

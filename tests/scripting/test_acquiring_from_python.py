"""`coupole.acquire` and `coupole.open_run`, over the wires of a simulated cell that outlives whoever acquires."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import cells
import numpy as np
import pytest
from cells import CellFolder

import coupole
from coupole.acquisition.run_control import ask
from sim.world.client import World

LIGHTING = """
import sys, time, coupole
with coupole.open_cell(sys.argv[1]) as cell:
    cell.ledbox.panel(1, on=True)
    print("lit", flush=True)
    while True:
        cell.ledbox.self_test()
        time.sleep(0.05)
"""
SCRIPT = """
import sys, coupole
for event in coupole.acquire(sys.argv[1]):
    print(event.event, flush=True)
"""


def place_of_led(number: int) -> list[float]:
    """Place of an LED by the dome's table, base frame, mm."""
    lines = (cells.REPO / "configs/domes/coupole.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    row = next(row for row in rows if int(row["id"]) == number)
    return [float(row[f"{axis}_mm"]) for axis in "xyz"]


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[CellFolder, World]]:
    cell = CellFolder(tmp_path_factory.mktemp("cell"), speed=4.0)
    cell.join()
    cell.write(lights={"kind": "every", "every": 20}, repeats=4)
    with cell.world() as world:
        yield cell, world


@pytest.fixture(scope="module")
def acquired(standing: tuple[CellFolder, World]) -> tuple[list[coupole.events.Event], Path, World]:
    """A run that an exception in the loop has stopped, and that was then resumed to its end: the resumed
    events."""
    cell, world = standing

    def stopped() -> Path:
        with coupole.acquire(cell.plan) as events:
            for event in events:
                if isinstance(event, coupole.events.FrameProven):
                    assert events.run is not None
                    raise ZeroDivisionError(events.run)
        raise AssertionError("no frame came")

    with pytest.raises(ZeroDivisionError) as raised:
        stopped()
    run = Path(raised.value.args[0])
    assert cells.safe(world)
    assert cells.events(run)[-1]["outcome"] == "interrupted"
    assert 0 < cells.frame_lines(run) < 216
    with coupole.acquire(resume=run) as events:
        return list(events), run, world


def test_a_run_that_an_exception_stopped_is_resumed_to_its_end(
    acquired: tuple[list[coupole.events.Event], Path, World],
) -> None:
    events, run, world = acquired
    assert cells.safe(world)
    cells.assert_each_shot_proven_once(run)
    written = cells.events(run)[-len(events) :]
    assert [event.event for event in events] == [event["event"] for event in written]
    assert isinstance(events[0], coupole.events.SessionResumed)
    assert isinstance(events[-1], coupole.events.SessionStopped)
    assert events[-1].outcome == "done"


def test_a_run_that_stands_still_is_told_and_ends_with_its_context_all_the_same(
    standing: tuple[CellFolder, World], caplog: pytest.LogCaptureFixture
) -> None:
    cell, world = standing
    with coupole.acquire(cell.plan) as events:
        next(event for event in events if isinstance(event, coupole.events.FrameProven))
        assert events.run is not None
        pid = ask(events.run, "state")["pid"]
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(2.5, os.kill, (pid, signal.SIGCONT)).start()
        held = next(event for event in events if isinstance(event, coupole.events.FaultNoted))
        assert "did not run for" in held.message
        assert "is stopped (SIGSTOP)" in caplog.text
        assert f"coupole go-on {events.run}" in caplog.text
        os.kill(pid, signal.SIGSTOP)
    assert cells.safe(world)
    assert cells.events(events.run)[-1]["outcome"] == "interrupted"


def test_frames_are_those_on_the_disk(acquired: tuple[list[coupole.events.Event], Path, World]) -> None:
    _, folder, _ = acquired
    stored = cells.stored(folder)
    with coupole.open_run(folder) as run:
        assert run.views == ("top",)
        assert run.missing == ()
        assert run.is_simulated
        assert len(run["top"].shots) == 216
        assert sorted(f"top/{label}" for label in run["top"]) == sorted(stored)
        for label in ("led0420/e0", "led0420/e0/r3", *run["top"].darks[:1]):
            frame, there = run["top"][label], stored[f"top/{label}"]
            np.testing.assert_array_equal(frame, there.pixels)
            assert (frame.exposure_us, frame.is_dark, frame.shape) == (8000, "dark" in label, (96, 128))
            np.testing.assert_array_equal(frame.base_from_camera, there.base_from_camera)
        assert run["top"]["led0420/e0"].led_position_mm == pytest.approx(place_of_led(420))
        assert run["top"][run["top"].darks[0]].led_position_mm is None
        with pytest.raises(KeyError, match=r"near names: led0420/e0"):
            run["top"]["led0421/e0"]
        with pytest.raises(KeyError, match="near names: top"):
            run["topp"]
    with pytest.raises(ValueError, match="was closed"):
        run["top"]


def test_a_frame_that_is_not_what_was_proven_is_refused(
    acquired: tuple[list[coupole.events.Event], Path, World],
) -> None:
    frame = coupole.open_run(acquired[1])["top"]["led1060/e0"]
    path = acquired[1] / "views/top.h5"
    content = path.read_bytes()
    place = content.index(frame.pixels.tobytes())
    path.write_bytes(content[:place] + b"\xff" + content[place + 1 :])
    with pytest.raises(coupole.errors.ChecksumMismatch, match="differs from what was proven"):
        np.asarray(frame)
    path.write_bytes(content)


def test_a_dataset_has_all_frames_of_a_view_with_units(
    acquired: tuple[list[coupole.events.Event], Path, World],
) -> None:
    run = coupole.open_run(acquired[1])
    dataset = run.dataset("top")
    assert dict(dataset.sizes) | {"shot": 216 + len(run["top"].darks), "y": 96, "x": 128} == dict(dataset.sizes)
    lit = dataset.isel(shot=list(dataset.shot.values).index("led0420/e0"))
    np.testing.assert_array_equal(lit.pixels.compute(), run["top"]["led0420/e0"].pixels)
    assert (int(lit.led), int(lit.exposure_us)) == (420, 8000)
    assert dataset.led_position_mm.attrs["units"] == "mm"
    assert dataset.pixels.attrs["units"] == "DN"
    assert int(dataset.is_dark.sum()) == len(run["top"].darks)


def test_without_the_extra_a_dataset_says_what_to_install(
    acquired: tuple[list[coupole.events.Event], Path, World], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'coupole\[xarray\]'"):
        coupole.open_run(acquired[1]).dataset("top")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_script_that_ends_leaves_the_cell_safe(
    standing: tuple[CellFolder, World], number: signal.Signals, code: int
) -> None:
    cell, world = standing
    before = {path.parent for path in (cell.folder / "storage").glob("2*/run.json")}
    script = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(cell.plan)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with script:
        assert script.stdout is not None
        while (line := script.stdout.readline().strip()) != "frame":
            assert line, "it ended"
        os.kill(script.pid, number)
        script.wait(cells.PATIENCE_S)
    assert script.returncode == code
    (run,) = {path.parent for path in (cell.folder / "storage").glob("2*/run.json")} - before
    stop = cells.wait_until(lambda: cells.events(run, "stop"), "the end of the session")
    assert stop[0]["outcome"] == "interrupted"
    assert cells.safe(world)


def test_what_the_command_would_refuse_is_raised_with_its_kind(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    plan = coupole.Plan.read(cell.plan)
    budget = plan.object.model_copy(update={"dose_budget_lux_h": 1e-6}) if plan.object else None
    refused = coupole.acquire(plan.model_copy(update={"object": budget}))
    with refused, pytest.raises(coupole.errors.PreflightRefused, match=r"its budget is 1e-06 lux\.h"):
        list(refused)
    assert refused.run is None
    with (
        coupole.acquire(tmp_path / "none.yaml") as none,
        pytest.raises(coupole.errors.InputError, match=r"none\.yaml"),
    ):
        next(none)
    with pytest.raises(coupole.errors.InputError, match="excludes `output`"):
        coupole.acquire(resume=tmp_path, output=tmp_path)


def test_a_folder_that_is_no_run_is_refused_as_the_commands_do(tmp_path: Path) -> None:
    with pytest.raises(coupole.errors.InputError) as refused:
        coupole.open_run(tmp_path)
    assert str(refused.value) in cells.here("verify", tmp_path).err


def test_devices_of_a_cell_are_off_when_the_context_ends(standing: tuple[CellFolder, World]) -> None:
    cell, world = standing

    def use() -> None:
        with coupole.open_cell(cell.rig) as devices:
            devices.ledbox.panel(1, on=True)
            assert world.ask("state")["panels"]
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        use()
    assert cells.safe(world)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_script_with_devices_that_freezes_or_dies_leaves_no_lamp_on(
    standing: tuple[CellFolder, World], number: signal.Signals
) -> None:
    """By the box's own watchdog: nobody else is left."""
    cell, world = standing
    command = [sys.executable, "-c", LIGHTING, str(cell.rig)]
    script = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    with script:
        try:
            assert script.stdout is not None
            assert script.stdout.readline().strip() == "lit"
            assert world.ask("state")["panels"]
            os.kill(script.pid, number)
            cells.wait_until(lambda: not world.ask("state")["panels"], "dark panels")
        finally:
            script.kill()
    assert cells.safe(world)


def test_a_real_cell_opens_only_with_the_word_that_its_support_is_empty() -> None:
    real = coupole.open_cell("la-coupole")
    with pytest.raises(coupole.errors.InputError, match="support_is_empty=True"), real:
        pass
    with_the_word = coupole.open_cell("la-coupole", support_is_empty=True)
    with pytest.raises(coupole.errors.PreflightRefused, match="commission"), with_the_word:
        pass

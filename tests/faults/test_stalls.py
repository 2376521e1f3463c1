"""Disks that are slow or stand still, a controller that does, viewers that hang: nothing is lost in silence."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import CellFolder
from expected_pictures import mislabelled
from gige import gige_port, needs_aravis

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
SOURCE = Path(__file__).with_name("slow_writes.c")
STALL_S = 10.0

needs_compiler = pytest.mark.skipif(not COMPILER, reason="no C compiler is here to build the slow disk with")


@pytest.fixture
def slowed(tmp_path: Path) -> Callable[..., dict[str, str]]:
    """The environment of a process whose writes are slowed as the settings of `slow_writes.c` say."""
    library = tmp_path / "slow_writes.so"

    def environment(**settings: float) -> dict[str, str]:
        subprocess.run([str(COMPILER), "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
        asked = {name: str(value) for name, value in settings.items()}
        return {**os.environ, "LD_PRELOAD": str(library), "SLOW_FROM": "20000", **asked}

    return environment


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    return CellFolder(tmp_path, speed=1.0)


def assert_whole(cell: CellFolder) -> None:
    cells.assert_each_shot_proven_once(cell.run_folder)
    assert mislabelled(cell, cell.run_folder) == []


@pytest.mark.full
@needs_compiler
def test_a_disk_slower_than_the_camera_slows_the_run_and_loses_nothing(
    cell: CellFolder, slowed: Callable[..., dict[str, str]]
) -> None:
    cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
    cell.write(lights={"kind": "every", "every": 54})
    slow_bytes_s = 30e6  # the camera gives 39 MB/s
    ended = cells.finish(cell.start_acquire(env=slowed(SLOW_BYTES_S=slow_bytes_s)))
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] == 0
    assert [burst["camera"]["overflows"] for burst in cells.events(cell.run_folder, "burst")] == [0]
    triggers_ns = sorted(int(frame.record["t_trigger_ns"]) for frame in cells.stored(cell.run_folder).values())
    assert np.diff(triggers_ns).min() * 1e-9 >= 512 * 384 * 2 / slow_bytes_s
    assert_whole(cell)


@needs_compiler
def test_a_disk_that_stands_still_for_ten_seconds_in_a_burst_loses_nothing(
    cell: CellFolder, slowed: Callable[..., dict[str, str]]
) -> None:
    started_s = time.monotonic()
    ended = cells.finish(cell.start_acquire(env=slowed(SLOW_STALL_AT=30, SLOW_STALL_S=STALL_S)))
    assert time.monotonic() - started_s > STALL_S
    assert ended.code == 0, ended.err
    assert_whole(cell)


@pytest.mark.full
@needs_compiler
@needs_aravis
def test_what_a_camera_on_the_network_lost_while_the_disk_stood_still_is_taken_again(
    cell: CellFolder, slowed: Callable[..., dict[str, str]]
) -> None:
    shipped: dict[str, Any] = cells.shipped_rig("sim-gige")
    cell.rig_data["camera"] = shipped["camera"]
    cell.write(lights={"kind": "every", "every": 2})
    with gige_port():
        ended = cells.finish(cell.start_acquire(env=slowed(SLOW_STALL_AT=30, SLOW_STALL_S=STALL_S)))
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] > 0
    assert_whole(cell)


@pytest.mark.full
def test_a_controller_that_stands_still_for_ten_seconds_in_a_burst_is_told_of_and_can_go_on(
    cell: CellFolder,
) -> None:
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = 2.0
    cell.join()
    cell.write(lights={"kind": "every", "every": 4})
    with cell.world() as world:
        process = cell.start_acquire()
        run = cell.run_folder
        cells.wait_until(lambda: cells.frame_lines(run) > 20, "proven frames")
        process.send_signal(signal.SIGSTOP)
        time.sleep(STALL_S)
        state = world.ask("state")
        process.send_signal(signal.SIGCONT)
        ended = cells.finish(process)
        assert not state["shining"]
        if ended.code:
            assert ended.code == 4, ended
            cell.confirm()
            assert cell.acquire("--resume", run).code == 0
    assert_whole(cell)


def test_a_viewer_that_hangs_holds_up_nothing(cell: CellFolder) -> None:
    cell.write(lights={"kind": "every", "every": 4})
    process = cell.start_acquire()
    run = cell.run_folder
    viewer = cells.start("live", run, "--yes")
    try:
        cells.wait_until(lambda: cells.frame_lines(run) > 20, "proven frames")
        viewer.send_signal(signal.SIGSTOP)
        ended = cells.finish(process)
    finally:
        viewer.send_signal(signal.SIGCONT)
        viewer.send_signal(signal.SIGINT)
        cells.finish(viewer)
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] == 0
    assert_whole(cell)

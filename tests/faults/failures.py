"""Runs that end by the failure of a device, and what must be true of them."""

from __future__ import annotations

from typing import Any

import cells
from cells import CellFolder, Ended
from expected_pictures import mislabelled

MORE_LIGHTS = {"kind": "every", "every": 4}
"""270 LEDs: a burst of 2.8 s."""


def fail_in_a_burst(cell: CellFolder, fault: dict[str, Any]) -> Ended:
    """Run the plan in a world in which `fault` happens at edge 20; the cell is safe when this returns."""
    with cell.world({**fault, "at_edge": 20}) as world:
        ended = cell.acquire()
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
    return ended


def assert_told(cell: CellFolder, ended: Ended, device: str) -> None:
    """Exit code, message, JSON and journal name the device that failed."""
    assert ended.code == 4, ended
    assert f"{device}: expected " in ended.err
    assert ended.document["error"].startswith(f"{device}: expected ")
    assert cells.events(cell.run_folder, "stop")[-1]["outcome"] == "failed"
    assert device in {fault["device"] for fault in cells.events(cell.run_folder, "fault")}


def assert_complete_once_mended(cell: CellFolder) -> None:
    """In a new world the run is resumed to its end."""
    run = cell.run_folder
    with cell.world():
        resumed = cell.acquire("--resume", run)
    assert resumed.code == 0, resumed.err
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(cell, run) == []

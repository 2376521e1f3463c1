"""Runs with processing beside them, for the tests of it."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import cells
from cells import CellFolder
from relief_cells import RECORDS, SIDE, shipped_cell

KINDS = ("camera", "flat-field", "hand-eye", "led-power", "leds", "response")
LOW = {**cells.LOW, "elevation_deg": 55}
OF_ITS_MAKING = {"seconds", "peak_memory_bytes"}


def cell_of_three_views(folder: Path, relief: Path = cells.COARSE_RELIEF, **plan: Any) -> CellFolder:
    """415 triangles: two blocks of work for each fit, and a tenth of the work that the whole relief is."""
    cell = shipped_cell(folder, relief)
    cell.write(
        views=[cells.TOP, SIDE, LOW],
        calibrations=[str(RECORDS / f"{kind}.yaml") for kind in KINDS],
        **{"lights": {"kind": "every", "every": 24}, **plan},
    )
    return cell


def acquired_run(folder: Path, **world: Any) -> CellFolder:
    """The cell, with a run that nothing has processed."""
    cell = cell_of_three_views(folder)
    cell.world_settings.update(world)
    cell.write()
    assert cell.acquire().code == 0
    return cell


def begun(cell: CellFolder, *options: str | Path) -> tuple[subprocess.Popen[str], int]:
    """An acquisition with processing beside it, and the number of that process, once its journal has begun."""
    process = cell.start_acquire("--reflectance", *options)
    cells.wait_until(lambda: cells.events(cell.run_folder, "processing"), "the session's first lines")
    worker = beside(process.pid)
    cells.wait_until(lambda: os.sched_getscheduler(worker) == os.SCHED_IDLE, "the lowest priority")
    assert os.getpriority(os.PRIO_PROCESS, worker) == 19
    hurry(worker)
    return process, worker


def hurry(pid: int) -> None:
    """Give a process a share again: on a busy machine one of the lowest priority starves for longer than tests
    wait."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # ended, or not ours to raise
            os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))
            os.setpriority(os.PRIO_PROCESS, int(task.name), 0)


def beside(pid: int) -> int:
    """The process beside that an acquisition has begun."""
    found = cells.wait_until(lambda: [child for child in cells.children(pid) if is_beside(child)], "its process")
    assert len(found) == 1
    return int(found[0])


def is_beside(pid: int) -> bool:
    try:
        return b"coupole.reflectance.beside.process" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def result_of(cell: CellFolder) -> Path:
    return cell.run_folder.with_name(f"{cell.run_folder.name}-reflectance")


def files(folder: Path) -> dict[str, Path]:
    return {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}


def same_result(one: Path, other: Path) -> None:
    """To the bit; `result.json`, which the report shows, tells how long it took and what memory."""
    mine, others = files(one), files(other)
    assert mine.keys() == others.keys()
    assert {"samples/low.h5", "samples/frames/top.h5", "fits/ggx_normal.h5", "fits/sh/side.h5"} < mine.keys()
    for name in mine.keys() - {"result.json", "report.html"}:
        assert mine[name].read_bytes() == others[name].read_bytes(), name
    told = [json.loads(result["result.json"].read_text()) for result in (mine, others)]
    for about in told:
        for key in OF_ITS_MAKING:
            del about[key]
    assert told[0] == told[1]

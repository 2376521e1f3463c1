"""Makes what is dear to make and only read afterwards, such as a run, once for all workers: the first whose tests
want it makes it, while the others wait. All find it in one folder of the session."""

from __future__ import annotations

import fcntl
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from cells import CellFolder

T = TypeVar("T")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """What `make(folder)` returned in this or another worker; it must be picklable, and nobody may change the
    folder. Whoever fails leaves no result: the next one tries anew."""
    session = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        session = session.parent
    shared = session / "made-once"
    shared.mkdir(exist_ok=True)
    kept = shared / f"{name}.pickle"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            folder = shared / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            made = make(folder)
            kept.write_bytes(pickle.dumps(made))
        result: T = pickle.loads(kept.read_bytes())
    return result


def copy_of_cell(cell: CellFolder, folder: Path) -> CellFolder:
    """The cell's files in another folder, which may be changed; rig and plan still name those of the first."""
    shutil.copytree(cell.folder, folder, dirs_exist_ok=True)
    copy = CellFolder(folder, speed=cell.speed, write_now=False)
    copy.rig_data, copy.plan_data = cell.rig_data, cell.plan_data
    return copy

"""The bench that a console keeps: what a stop does before it answers, and that nobody leaves devices open."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder

from coupole.console.cell import bench_keeper
from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.bench_keeper import IDLE_S, Bench
from coupole.console.cell.lending import Lending
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.plans.plan_queue import PlanQueue
from coupole.console.processes import tasks
from coupole.errors import InputError
from coupole.plan.cell import read_cell

_BENCH = "trap 'exit 130' INT; echo ready >&2; while :; do sleep 0.05; done"
"""What stands for `coupole bench`: it can be interrupted."""


class Kept:
    """A bench whose process stands for one, and whose socket answers what a test says."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        cell = read_cell(CellFolder(folder).rig)
        self.now_s = 0.0
        self.answers: dict[str, Any] | None = None
        monkeypatch.setattr(tasks, "_COUPOLE", ("/bin/sh", "-c", _BENCH))
        monkeypatch.setattr(bench_keeper, "ask_bench", self._ask)
        monkeypatch.setattr(bench_keeper, "bench_socket", lambda _: folder)
        self.acquisitions = Acquisitions(PlanQueue(folder / "queue.json"), cell, folder / "output")
        plans = PlanFiles(folder, cell.document.path, folder / "drawings")
        self.bench = Bench(cell, self.acquisitions, plans, folder / "bench", lambda: self.now_s)
        self.bench.open("Ada", "")
        self.task = self.bench._tasks.newest_first[0]
        cells.wait_until(lambda: "ready" in self.task.output_text, "its process")

    def _ask(self, _: object, command: str, **fields: object) -> dict[str, Any]:
        if self.answers is None:
            raise InputError("it does not answer")
        if command == "close":
            self.task.stop()
        return self.answers


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Kept]:
    found = Kept(tmp_path, monkeypatch)
    yield found
    found.bench._tasks.close()


def test_a_stop_interrupts_devices_that_are_being_opened_and_the_cell_is_given_back(kept: Kept) -> None:
    assert kept.bench.phase == "opening"
    assert kept.acquisitions.lending.lent_to == "Ada: the devices are open"
    assert "make the cell safe and end" in kept.bench.stop()[0]
    kept.task.wait(cells.PATIENCE_S)
    assert kept.task.exit_code == 130
    assert (kept.bench.phase, kept.acquisitions.lending.lent_to) == ("closed", "")


@pytest.mark.parametrize("use", [lambda _: None, lambda bench: bench.looked_at()], ids=["alone", "looked at"])
def test_devices_that_nobody_uses_for_ten_minutes_are_closed(kept: Kept, use: Callable[[Bench], None]) -> None:
    bench = kept.bench
    kept.answers = {"trouble": [], "work": {"state": "running"}}
    kept.now_s = IDLE_S + 100.0
    use(bench)
    bench._look()
    assert bench.phase == "open", "the arm moves"
    kept.answers = {"trouble": [], "work": {"state": "done"}}
    kept.now_s += IDLE_S - 1.0
    use(bench)
    bench._look()
    assert bench.phase == "open"
    kept.now_s += 3.0
    use(bench)
    bench._look()
    assert (bench.phase, bench.closed_because) == ("closed", "nobody has used the devices for 10 minutes")
    assert not kept.task.running


def test_using_devices_keeps_them_open(kept: Kept) -> None:
    kept.answers = {"trouble": [], "work": {"state": "done"}}
    kept.now_s = IDLE_S - 1.0
    kept.bench.ask("frame")
    kept.now_s += IDLE_S - 1.0
    kept.bench._look()
    assert kept.bench.phase == "open"


def test_whatever_the_cell_is_lent_for_is_interrupted_as_by_a_key() -> None:
    lending, waits = Lending(), "import time; print('mine', flush=True); time.sleep(60)"
    with subprocess.Popen(
        [sys.executable, "-S", "-c", waits], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as borrower:
        assert borrower.stdout is not None
        borrower.stdout.readline()
        lending.lend(borrower.pid, "Ada", "live")
        lending.interrupt()
        assert borrower.wait(cells.PATIENCE_S) == -signal.SIGINT
    assert lending.lent_to == ""
    with pytest.raises(InputError, match="not lent"):
        lending.interrupt()


def test_live_pictures_end_with_the_page_with_a_stop_and_when_nobody_touches_it() -> None:
    from coupole.console.screens.focus_screen import LIVE_S, why_live_ends

    usual: dict[str, Any] = {"is_watched": True, "untouched_s": 59.0, "is_stopped": False}
    assert LIVE_S == 60.0
    assert why_live_ends(**usual) == ""
    assert "60 s" in why_live_ends(**{**usual, "untouched_s": 61.0})
    assert "closed" in why_live_ends(**{**usual, "is_watched": False})
    assert why_live_ends(**{**usual, "is_stopped": True}) == "stopped"

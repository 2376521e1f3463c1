"""Commands that people begin at the console, and processes that compute for it, when the console is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.acquisition.cell_bench.bench_client import ask_bench, bench_socket
from coupole.plan.cell import read_cell

_CONSOLE = """
import sys, threading, time
from pathlib import Path
from coupole.console.processes import tasks
tasks._COUPOLE = ("/bin/sh",)
begun = []
all_tasks = tasks.Tasks(Path(sys.argv[1]))
thread = threading.Thread(target=lambda: begun.append(all_tasks.begin("waits", ["-c", "exec sleep 60"], "Ada")))
thread.start(); thread.join()
time.sleep(0.3)
print(begun[0].process.pid, begun[0].running, flush=True)
time.sleep(60)
"""


_COMPUTES = """
import os, time
from coupole.console.processes import warm_process
warm_process._IMPORTED = []
process = warm_process.WarmProcess("computes")
print(process.run(os.getpid, 60.0), True, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("console", [_CONSOLE, _COMPUTES], ids=["commands", "computes"])
def test_what_a_killed_console_has_begun_is_interrupted_and_nothing_is_before(
    tmp_path: Path, console: str
) -> None:
    command = [sys.executable, "-c", console, tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        number, running = process.stdout.readline().split()
        began = os.pidfd_open(int(number))
        try:
            assert running == "True", "the thread that asked for it has ended, the console has not"
            process.kill()
            cells.wait_until(lambda: _ended(began), "the end of what it has begun")
        finally:
            if not _ended(began):
                signal.pidfd_send_signal(began, signal.SIGKILL)
            os.close(began)


def _ended(process: int) -> bool:
    try:
        signal.pidfd_send_signal(process, 0)
    except ProcessLookupError:
        return True
    return False


_OPENS_DEVICES = """
import sys, time
from pathlib import Path
from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.bench_keeper import Bench
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.plans.plan_queue import PlanQueue
from coupole.plan.cell import read_cell
folder = Path(sys.argv[1])
cell = read_cell(folder / "rig.yaml")
acquisitions = Acquisitions(PlanQueue(folder / "queue.json"), cell, folder / "output")
plans = PlanFiles(folder, folder / "rig.yaml", folder / "drawings")
with Bench(cell, acquisitions, plans, folder / "bench") as bench:
    bench.open("Ada", "")
    while bench.phase != "open":
        bench.looked_at()
        time.sleep(0.1)
    print(bench._running.process.pid, flush=True)
    time.sleep(600)
"""


@pytest.mark.full  # of anything that a console has begun: above
def test_the_devices_of_a_killed_console_are_made_safe_and_closed(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.join()
    with cell.world() as world:
        command = [sys.executable, "-c", _OPENS_DEVICES, tmp_path]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            bench = os.pidfd_open(int(process.stdout.readline()))
            asked = ask_bench(read_cell(cell.rig), "state")
            assert asked["devices"]
            process.kill()
            cells.wait_until(lambda: _ended(bench), "the end of the bench")
            os.close(bench)
        assert cells.safe(world)
        assert not bench_socket(read_cell(cell.rig)).exists()

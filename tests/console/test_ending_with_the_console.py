"""Commands that people begin at the console, when the console is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import cells

_CONSOLE = """
import sys, threading, time
from pathlib import Path
from coupole.console import tasks
tasks._COUPOLE = ("/bin/sh",)
begun = []
all_tasks = tasks.Tasks(Path(sys.argv[1]))
thread = threading.Thread(target=lambda: begun.append(all_tasks.begin("waits", ["-c", "exec sleep 60"], "Ada")))
thread.start(); thread.join()
time.sleep(0.3)
print(begun[0].process.pid, begun[0].running, flush=True)
time.sleep(60)
"""


def test_what_a_killed_console_has_begun_is_interrupted_and_nothing_is_before(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _CONSOLE, tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as console:
        assert console.stdout is not None
        number, running = console.stdout.readline().split()
        began = os.pidfd_open(int(number))
        try:
            assert running == "True", "the thread that asked for it has ended, the console has not"
            console.kill()
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

"""The lowest priority while frames come, and that of usual background work after them, also for a process that may
not raise its priority."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

PROGRAM = """
import contextlib, json, os, threading
from concurrent.futures import ThreadPoolExecutor
from coupole.reflectance.beside.lowest_priority import ThreadForTheEnd, yield_to_all_others

if os.geteuid() == 0:
    os.setuid(65534)  # nobody: has no right to raise a priority
for_the_end = ThreadForTheEnd()
yield_to_all_others(but=for_the_end)
told = {}

def tell(name):
    told[name] = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

def tell_of_threads(name):
    tell(name)
    with ThreadPoolExecutor(1) as pool:
        pool.submit(tell, f"begun by {name}").result()

tell_of_threads("main")
for_the_end.run(lambda: tell_of_threads("end"))
try:
    for_the_end.run(lambda: 1 / 0)
except ZeroDivisionError:
    told["error"] = True
print(json.dumps(told))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere, priorities are those of whole processes")
@pytest.mark.parametrize(("nice", "nice_of_the_end"), [(0, 10), (15, 15)])
def test_only_the_work_after_the_last_frame_has_more_than_the_lowest_priority(
    nice: int, nice_of_the_end: int
) -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)
    command = ["nice", "-n", str(max(0, nice - own)), sys.executable, "-c", PROGRAM]
    told = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout)
    lowest, usual = [os.SCHED_IDLE, 19], [os.SCHED_OTHER, max(nice_of_the_end, own)]
    assert told == {
        "main": lowest,
        "begun by main": lowest,
        "end": usual,
        "begun by end": usual,
        "error": True,
    }

"""The world's clock as its readers see it: at its pace, held by the horizon, and not for ever by a dead world."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from cells import wait_until
from places import REPO

from coupole.clock import Deadline
from sim.world.clock import FOREVER_NS, ClockWriter, SharedClock

WORLD = """
import sys, time, pathlib
from sim.world.clock import ClockWriter
clock = ClockWriter(pathlib.Path(sys.argv[1]), 10.0)
clock.publish(10**9)
print("runs", flush=True)
if sys.argv[2] == "closes":
    sys.stdin.readline()
    clock.close()
time.sleep(600)
"""


@pytest.mark.parametrize("end", ["killed", "closes"])
def test_time_goes_on_when_the_world_has_ended(tmp_path: Path, end: str) -> None:
    """Held at its horizon of one second by a world that stands still, time moves again once that has ended."""
    command = [sys.executable, "-c", WORLD, str(tmp_path / "clock"), end]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPO) as world:
        assert world.stdout is not None
        assert world.stdin is not None
        world.stdout.readline()
        clock = SharedClock(tmp_path / "clock")
        wait_until(lambda: clock.now_ns() == 10**9, "the horizon")
        assert clock.alive
        deadline = Deadline(clock, 0.5)
        if end == "closes":
            world.stdin.close()
        else:
            world.kill()
        wait_until(lambda: deadline.has_expired, "the end of the wait")
        assert not clock.alive
        before_ns = clock.now_ns()
        clock.sleep(0.2)
        assert clock.now_ns() >= before_ns + 200_000_000
        world.kill()


def test_the_clock_of_a_world_that_has_long_ended_goes_on(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WORLD, str(tmp_path / "clock"), "killed"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=REPO) as world:
        assert world.stdout is not None
        world.stdout.readline()
        world.kill()
    clock = SharedClock(tmp_path / "clock")
    assert not clock.alive
    clock.sleep(0.1)


def test_time_stops_at_the_horizon_and_never_runs_backwards(tmp_path: Path) -> None:
    writer = ClockWriter(tmp_path / "clock", 1000.0)
    clock = SharedClock(tmp_path / "clock")
    writer.publish(5_000_000)
    wait_until(lambda: clock.now_ns() == 5_000_000, "the horizon")
    writer.slip_to(1_000_000)
    writer.publish(FOREVER_NS)
    assert clock.now_ns() >= 5_000_000
    assert clock.alive

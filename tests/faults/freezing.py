"""A run whose processes are frozen (SIGSTOP) in motions and bursts, and what the world saw of it.

The world is kept outside and runs at the pace of life; RSI is not paced by its answers. Used by a test that
freezes a few times, and by `tools/freeze_at_random.py`, which does so hundreds of times.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cells
import numpy as np
from cells import SIDE, TOP, CellFolder
from numpy.typing import NDArray

from coupole.acquisition.run_control import ask
from coupole.errors import CoupoleError
from coupole.supervision import ATTENTION_S
from sim.world.client import World

ARMS = ("rsi", "eki", "ur")
FROZEN = ("controller", "arm's process")
"""Whose process: that of the command, or that which answers the arm (RSI, UR)."""
BRAKES_WITHIN_S = 0.15
WATCHDOG_S = 2.0
_FREEZE_S = 1.6
"""Longer than the lapse after which a person is asked."""
_LOOK_S = 0.002
_WINDOW_S = 0.036
"""Three cycles of RSI, to measure speeds over."""
_LAPSE_S = 0.06
"""Before the lapse of attention, to measure how the arm was gaining speed."""
_JERK_DEG_S3 = {"rsi": 3000.0, "eki": 3000.0}
"""As the rigs have it; `stopj` of a UR has none and eases at once."""
_AT_REST_DEG_S = 0.5
_SETTINGS: dict[str, dict[str, Any]] = {
    "rsi": {"driver": "drivers.kuka.rsi:KukaRsi", "settings": {"cycle_ms": 12}},
    "eki": {"driver": "drivers.kuka.eki:KukaEki"},
}


@dataclass
class Freeze:
    """One freeze, in seconds of the machine's clock from the signal on."""

    arm: str
    frozen: str
    while_moving: bool
    brakes_s: float | None = None
    """Until the fastest axis was at its fastest; None if the arm did not move."""
    eases_s: float = 0.0
    """Of that, after attention had lapsed: an arm that gains speed takes back its acceleration, at its jerk."""
    still_s: float | None = None
    """Until the arm stood."""
    turned_deg: float = 0.0
    """Of the axis that turned farthest from the signal on."""
    dark_s: float | None = None
    """Until the last lamp went off; None if none shone."""
    late_s: float = 0.0
    """Longest time between two looks of this harness: a busy machine cannot measure shorter ones."""

    @property
    def wrong(self) -> list[str]:
        """What breaks a promise, beyond what the harness itself may have been late."""
        found = []
        if self.brakes_s is not None and self.brakes_s > BRAKES_WITHIN_S + self.eases_s + self.late_s:
            found.append(f"braking began only after {self.brakes_s:.3f} s")
        if self.while_moving and self.still_s is None:
            found.append("the arm did not come to rest")
        if self.dark_s is not None and self.dark_s > WATCHDOG_S + 0.1 + self.late_s:
            found.append(f"a lamp shone for {self.dark_s:.2f} s")
        return found

    def line(self) -> dict[str, Any]:
        return {**asdict(self), "wrong": self.wrong}


def cell_in(folder: Path, arm: str) -> CellFolder:
    """Two views of 54 LEDs, a slow motion to each; a burst lasts longer than the box's watchdog."""
    cell = CellFolder(folder, speed=1.0)
    if arm == "ur":
        cell.moved_by_ur("ur10e", patient=False)
    else:
        cell.rig_data["robot"] = _SETTINGS[arm]
    cell.rig_data["motion"] |= {"speed_fraction": 0.1}
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = WATCHDOG_S
    cell.join()
    cell.write(views=[TOP, SIDE], exposure={"kind": "fixed", "exposure_us": 80_000})
    return cell


@contextmanager
def world_of(cell: CellFolder, arm: str) -> Iterator[World]:
    """A world at the pace of life, whose arm waits for nobody."""
    robots: dict[str, dict[str, Any]] = {
        "rsi": {"kind": "rsi", "sends_to": "127.0.0.1:0", "cycle_ms": 12, "lock_step": False},
        "eki": {"kind": "eki", "write_limit_s": 0.01},
    }
    real_time = {"robot": robots[arm]} if arm in robots else {}
    with cell.world(**real_time) as world:
        yield world


@contextmanager
def running(cell: CellFolder, arm: str) -> Iterator[tuple[World, subprocess.Popen[str]]]:
    """A world and a run in it, ended with the context at the latest."""
    with ExitStack() as stack:
        world = stack.enter_context(world_of(cell, arm))
        process = stack.enter_context(cell.start_acquire())
        stack.callback(_end, process)
        yield world, process


def freeze(world: World, pid: int, about: Freeze) -> Freeze:
    """Freeze a process and look at the world; the process goes on when this returns."""
    os.kill(pid, signal.SIGSTOP)
    began_s = last_s = time.monotonic()
    seen: list[tuple[float, float, list[float]]] = []
    try:
        while (now_s := time.monotonic()) - began_s < _FREEZE_S + (WATCHDOG_S if not about.while_moving else 0.0):
            state = world.ask("state")
            about.late_s = max(about.late_s, time.monotonic() - last_s)
            last_s = now_s
            seen.append((now_s - began_s, state["t_s"], state["joints_deg"]))
            if state["shining"] or state["panels"]:
                about.dark_s = now_s - began_s
            time.sleep(_LOOK_S)
    finally:
        with suppress(ProcessLookupError):  # ended meanwhile
            os.kill(pid, signal.SIGCONT)
    about.turned_deg = max(
        max(abs(a - b) for a, b in zip(joints, seen[0][2], strict=True)) for _, _, joints in seen
    )
    if about.while_moving:
        _measure_braking(about, seen)
    return about


def _measure_braking(about: Freeze, seen: list[tuple[float, float, list[float]]]) -> None:
    """When the fastest axis was at its fastest, and when it stood; by differences over `_WINDOW_S` of the world,
    whose arm is set once a cycle."""
    at_s, t_s = (np.array([one[k] for one in seen]) for k in (0, 1))
    joints_deg = np.array([one[2] for one in seen])
    before = np.searchsorted(t_s, t_s - _WINDOW_S)
    before, after = before[before < np.arange(len(seen))], np.flatnonzero(before < np.arange(len(seen)))
    turned_deg = np.abs(joints_deg[after] - joints_deg[before])
    speeds_deg_s = turned_deg.max(axis=1) / (t_s[after] - t_s[before])
    when_s = (at_s[after] + at_s[before]) / 2.0
    if speeds_deg_s.max() < _AT_REST_DEG_S:
        about.still_s = 0.0
        return
    about.brakes_s = float(when_s[speeds_deg_s > 0.98 * speeds_deg_s.max()].max())
    if about.arm in _JERK_DEG_S3:
        fastest = int(np.argmax(np.ptp(joints_deg, axis=0)))
        about.eases_s = _gain_deg_s2(at_s, joints_deg[:, fastest]) / _JERK_DEG_S3[about.arm]
    if speeds_deg_s[-1] < _AT_REST_DEG_S:
        about.still_s = float(when_s[speeds_deg_s >= _AT_REST_DEG_S].max())


def _gain_deg_s2(at_s: NDArray[np.float64], joint_deg: NDArray[np.float64]) -> float:
    """By how much an axis was gaining speed just before attention lapsed, at least 0: of a parabola through it."""
    about = (at_s > ATTENTION_S - _LAPSE_S) & (at_s < ATTENTION_S)
    if about.sum() < 4:
        return 0.0
    curvature, slope, _ = np.polyfit(at_s[about] - at_s[about][0], joint_deg[about], 2)
    return max(2.0 * float(curvature) * (1.0 if slope > 0 else -1.0), 0.0)


def moment(world: World, process: subprocess.Popen[str], draw: random.Random, *, moving: bool) -> bool:
    """Wait for a random moment of a motion, or of a burst; False if the run ended before one came."""
    while process.poll() is None:
        state = world.ask("state")
        if (state["arm_moving"] and not state["shining"]) if moving else state["shining"]:
            time.sleep(draw.uniform(0.0, 0.6))
            return process.poll() is None
        time.sleep(0.005)
    return False


def frozen_pid(process: subprocess.Popen[str], which: str) -> int:
    """The process to freeze; for an arm without one of its own, the command's."""
    kin = [pid for pid in cells.children(process.pid) if _answers_an_arm(pid)]
    return kin[0] if kin and which != FROZEN[0] else process.pid


def _answers_an_arm(pid: int) -> bool:
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    return any(b"rsi.loop" in word or b"ur.worker" in word for word in words)


def go_on(run: Path, process: subprocess.Popen[str]) -> bool:
    """A person's word, once the run asks for it; False if it ended instead."""
    while process.poll() is None:
        try:
            state = ask(run, "state")["state"]
            if state == "paused":
                ask(run, "go-on")
                return True
        except CoupoleError:
            pass
        time.sleep(0.02)
    return False


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGCONT)
        process.terminate()


def lines_in(path: Path) -> list[dict[str, Any]]:
    """What was kept of freezes already done."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

"""The emergency stop is pressed during a motion. The arm must stop, the driver must report the fault, and nothing
may move the arm afterwards."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.clock import Deadline
from coupole.devices import ArmState
from coupole.errors import DeviceError, DeviceFault

_PACE_S = 3.0
"""Duration of each motion to and fro."""
_PRESSED_WITHIN_S = 90.0
_POLL_S = 0.01
_WATCHED_S = 2.0
_STILL_DEG = 0.02
_ARRIVED_DEG = 0.1
_TOLD_WITHIN_S = 3.0
"""Time within which the fault of an arm that stopped on its way is reported."""
_SPEED_OVER_S, _MOMENT_S = 0.3, 0.08
"""Times over which speeds are measured: the time of the motion, and a time in which the arm has begun to brake.
Reports come unevenly, so speeds over shorter times are noise."""
_FAST_SHARE = 0.5
"""Share of an axis's greatest speed in this session; the axis must have been this fast."""
_STEADY_SHARE = 0.8
"""Share of the speed of the motion; the arm brakes when it is slower."""
_PRESSED_AT_REST = (
    "the arm's fault ({}) came while the arm was not at speed, so nothing was measured: release the emergency "
    "stop, acknowledge it, start the robot program again, and repeat the step; press while the arm turns"
)


def emergency_stop(bench: Bench) -> None:
    """Move an axis to and fro until the person presses the emergency stop."""
    findings, robot = bench.findings, bench.opened.robot
    findings.remedy = (
        "Check the controller's safety circuit and its programs: after an emergency stop nothing may move the "
        "arm until its program is started again. Do not run any plan."
    )
    bench.ask_before(
        "Step emergency-stop: the arm turns slowly to and fro. Press the emergency stop while it moves, and do "
        "not release it before you are asked."
    )
    promised_deg = robot.stopping_deg()
    press = _moved_until_pressed(bench)
    rested_deg = _last_known_deg(bench, press.joints_deg)
    turned_deg = float(np.max(np.abs(rested_deg - press.joints_deg) - press.unsure_deg - promised_deg))
    findings.at_most("turn after the press, in excess of the promised angle", max(turned_deg, 0.0), 0.0, "deg")
    is_accepted = True
    try:
        robot.move_to(press.joints_deg)
    except DeviceError as error:
        is_accepted = False
        findings.remarks.append(f"a motion was refused: {error}")
    findings.at_most("motions that were accepted after the emergency stop", int(is_accepted), 0, "")
    bench.opened.clock.sleep(_WATCHED_S)
    further_deg = float(np.abs(_last_known_deg(bench, rested_deg) - rested_deg).max())
    findings.at_most("turn of the axes at rest", further_deg, _STILL_DEG, "deg")
    bench.ask_whether("Did the arm stop at once, and has it stood still since?")
    bench.person.tell("Release the emergency stop, acknowledge it, reset the robot program, start it again.")


def _moved_until_pressed(bench: Bench) -> _Press:
    """Return where the arm was when it began to brake. Raises StepFailedError if no fault is seen, or if the arm
    was not at speed before it."""
    robot, clock = bench.opened.robot, bench.opened.clock
    home_deg = bench.joints_deg()
    change_deg = np.zeros(6)
    change_deg[0] = _PACE_S * bench.velocity_deg_s[0]
    change_deg = bench.clear_change(change_deg)
    fast_deg_s = _FAST_SHARE * float(bench.velocity_deg_s[0])
    deadline, out = Deadline(clock, _PRESSED_WITHIN_S), False
    ask = functools.cache(bench.person.press_emergency_stop)  # once
    while not deadline.has_expired:
        out = not out
        bench.pause(_POLL_S)
        way = _Way(home_deg + change_deg if out else home_deg)
        try:
            robot.move_to(way.target_deg)
        except DeviceFault as error:  # pressed since the last look at the arm
            raise StepFailedError(_PRESSED_AT_REST.format(error.happened)) from error
        if fault := _follow(bench, way, fast_deg_s, ask):
            bench.findings.remarks.append(f"the arm's fault: {fault}")
            return way.press(fast_deg_s, robot.stopping_deg(), fault)
    robot.stop()
    raise StepFailedError(
        f"no fault of the arm was seen within {_PRESSED_WITHIN_S:g} s: if the emergency stop was pressed, the "
        "controller does not report it; otherwise repeat the step"
    )


def _follow(bench: Bench, way: _Way, fast_deg_s: float, ask: Callable[[], None]) -> str:
    """Follow a motion until the arm has arrived; return its fault if there is one. `ask` is called when an axis
    has reached the required speed. The reason why an arm stopped on its way may be reported later."""
    robot, clock = bench.opened.robot, bench.opened.clock
    fault_deadline = Deadline(clock, _TOLD_WITHIN_S)
    while True:
        state = robot.measured()
        way.add(state)
        if state.fault:
            return state.fault
        if state.moving:
            fault_deadline = Deadline(clock, _TOLD_WITHIN_S)
        elif way.has_arrived or fault_deadline.has_expired:
            return ""
        if way.speed_deg_s() >= fast_deg_s:
            ask()
        bench.pause(_POLL_S)


@dataclass(frozen=True)
class _Press:
    """The place of the arm when the emergency stop began to brake it."""

    joints_deg: NDArray[np.float64]
    """[6] last reported axes before it slowed down."""
    unsure_deg: NDArray[np.float64]
    """[6] turn of the axes until the next report: the arm may have begun to brake anywhere in between."""


@dataclass
class _Way:
    """The reports of one motion so far."""

    target_deg: NDArray[np.float64]
    """[6]"""
    reports: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)
    """Times, ns, and axes [6]."""

    def add(self, state: ArmState) -> None:
        """Add a report, unless it is the last one again."""
        if not self.reports or state.t_ns > self.reports[-1][0]:
            self.reports.append((state.t_ns, np.array(state.joints_deg)))

    @property
    def has_arrived(self) -> bool:
        """True if the arm is at the target."""
        return bool(np.abs(self.reports[-1][1] - self.target_deg).max() <= _ARRIVED_DEG)

    def speed_deg_s(self, number: int = -1, over_s: float = _SPEED_OVER_S) -> float:
        """Return the speed of the fastest axis over the time before a report; 0 if there is no earlier one."""
        now_ns, now_deg = self.reports[number]
        before = [report for report in self.reports if now_ns - report[0] >= over_s * 1e9]
        if not before:
            return 0.0
        then_ns, then_deg = before[-1]
        return float(np.abs(now_deg - then_deg).max()) / ((now_ns - then_ns) * 1e-9)

    def press(self, fast_deg_s: float, stopping_deg: NDArray[np.float64], fault: str) -> _Press:
        """Return where the arm began to brake before this fault was seen. Raises StepFailedError if it was not as
        fast as this, or so near its target that it would have braked anyway."""
        numbers = range(len(self.reports))
        steady_deg_s = max(self.speed_deg_s(number) for number in numbers)
        least_deg_s = _STEADY_SHARE * steady_deg_s
        at_speed = [number for number in numbers if self.speed_deg_s(number, _MOMENT_S) >= least_deg_s]
        if steady_deg_s < fast_deg_s or not at_speed:
            raise StepFailedError(_PRESSED_AT_REST.format(fault))
        last = at_speed[-1]
        joints_deg = self.reports[last][1]
        if np.all(np.abs(self.target_deg - joints_deg) <= stopping_deg):
            raise StepFailedError(_PRESSED_AT_REST.format(fault))
        return _Press(joints_deg, np.abs(self.reports[min(last + 1, len(self.reports) - 1)][1] - joints_deg))


def _last_known_deg(bench: Bench, before_deg: np.ndarray) -> np.ndarray:
    """Return the axes [6] once they rest. If the controller no longer answers, these are the last known ones."""
    deadline = Deadline(bench.opened.clock, _WATCHED_S)
    last_deg = before_deg
    with contextlib.suppress(DeviceError):
        while not deadline.has_expired:
            state: ArmState = bench.opened.robot.measured()
            now_deg = np.array(state.joints_deg)
            bench.opened.clock.sleep(0.1)
            if np.array_equal(now_deg, last_deg) and not state.moving:
                return now_deg
            last_deg = now_deg
    return last_deg

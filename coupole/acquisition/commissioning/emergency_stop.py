"""The emergency stop is pressed during a motion. The arm must stop, its fault must be seen here, and nothing may
move it on."""

from __future__ import annotations

import contextlib

import numpy as np

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
    at_press_deg = _moved_until_pressed(bench)
    rested_deg = _last_known_deg(bench, at_press_deg)
    turned_deg = float(np.max(np.abs(rested_deg - at_press_deg) - promised_deg))
    findings.at_most(
        "turn after the fault was seen, in excess of the promised angle", max(turned_deg, 0.0), 0.0, "deg"
    )
    is_accepted = True
    try:
        robot.move_to(at_press_deg)
    except DeviceError as error:
        is_accepted = False
        findings.remarks.append(f"a motion was refused: {error}")
    findings.at_most("motions that are accepted after the emergency stop", int(is_accepted), 0, "")
    bench.opened.clock.sleep(_WATCHED_S)
    further_deg = float(np.abs(_last_known_deg(bench, rested_deg) - rested_deg).max())
    findings.at_most("turn of the axes at rest", further_deg, _STILL_DEG, "deg")
    bench.ask_whether("Did the arm stop at once, and has it stood still since?")
    bench.person.tell("Release the emergency stop, acknowledge it, reset the robot program, start it again.")


def _moved_until_pressed(bench: Bench) -> np.ndarray:
    """Return the axes [6] when the fault was first seen. Raises StepFailedError if no fault is seen."""
    robot, clock = bench.opened.robot, bench.opened.clock
    home_deg = bench.joints_deg()
    change_deg = np.zeros(6)
    change_deg[0] = _PACE_S * bench.velocity_deg_s[0]
    change_deg = bench.clear_change(change_deg)
    deadline, out = Deadline(clock, _PRESSED_WITHIN_S), False
    is_asked = False
    while not deadline.has_expired:
        out = not out
        bench.pause(_POLL_S)
        try:
            robot.move_to(home_deg + change_deg if out else home_deg)
        except DeviceFault as error:  # pressed since the last look at the arm
            bench.findings.remarks.append(f"the arm's fault: {error.happened}")
            return bench.joints_deg()
        while (state := robot.measured()).moving or state.fault:
            if state.fault:
                bench.findings.remarks.append(f"the arm's fault: {state.fault}")
                return np.array(state.joints_deg)
            if not is_asked:
                bench.person.press_emergency_stop()
                is_asked = True
            bench.pause(_POLL_S)
    robot.stop()
    raise StepFailedError(
        f"no fault of the arm was seen within {_PRESSED_WITHIN_S:g} s: if the emergency stop was pressed, the "
        "controller does not report it; otherwise repeat the step"
    )


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

"""Steps with the arm: the controller's cycle, the directions of the axes, and the angles to a stop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.acquisition.commissioning.directions import described_motion
from coupole.clock import Deadline
from coupole.kinematics import forward
from coupole.motion.itinerary import arm_of
from coupole.plan.registry import settings_class
from coupole.plan.rig_devices import device_for

CYCLES = {"cycle_ms": "packets", "status_ms": "statuses", "frequency_hz": "samples"}
"""Settings of drivers that state how often the controller reports. The value is the name of the figure of
`Robot.statistics` that counts these reports."""
_CYCLE_S = 3.0
_CYCLE_DEVIATION = 0.05
"""Greatest deviation of the period of the controller's reports, as a share. A larger deviation shows a different
cycle, not an inaccurate quartz."""
_LENS_MM, _LEAST_DEG, _MOST_DEG = 15.0, 3.0, 10.0
_TURNED_DEG, _OTHERS_DEG = 0.05, 0.05
_SHARES = (1.0, 0.5, 0.25)
"""Shares of the reduced speed at which stops are measured."""
_CRUISE_S = 2.0
_POLL_S, _SPEED_OVER_S = 0.004, 0.08
_TRIES = 5
_STILL_S, _STILL_DEG = 0.3, 0.003
_LONGEST_STOP_S = 10.0


def cycle(bench: Bench) -> None:
    """Count the controller's reports for some seconds, and compare their period with the period that the driver
    expects."""
    findings, robot, clock = bench.findings, bench.opened.robot, bench.opened.clock
    findings.remedy = (
        "Set the driver's cycle to that of the controller's program, or repair the network between them."
    )
    bench.ask_before("Step cycle: the arm stands still while the controller's reports are counted.")
    driver, settings = device_for(bench.cell.rig, "robot", dry_run=False)
    model = settings_class(driver)
    setting = next((name for name in CYCLES if name in model.model_fields), None)
    if setting is None:
        findings.remarks.append(f"{driver} does not say how often its controller reports; nothing was compared")
        return
    rig_cycle = float(settings.get(setting, model.model_fields[setting].default))
    expected_ms = 1e3 / rig_cycle if setting == "frequency_hz" else rig_cycle
    before, begun_ns = robot.statistics()[CYCLES[setting]], clock.now_ns()
    bench.pause(_CYCLE_S)
    after, ended_ns = robot.statistics()[CYCLES[setting]], clock.now_ns()
    found_ms = (ended_ns - begun_ns) / 1e6 / (after - before) if after > before else np.inf
    findings.remarks.append(f"a report every {found_ms:.3f} ms, over {(ended_ns - begun_ns) / 1e9:.1f} s")
    findings.at_most(
        f"deviation of the controller's cycle from {expected_ms:g} ms",
        abs(found_ms - expected_ms),
        _CYCLE_DEVIATION * expected_ms,
        "ms",
    )


def axes(bench: Bench) -> None:
    """Turn each axis by a few degrees: the measured change, and the motion that the person sees, must agree with
    the rig's arm.

    The angles that a controller reports are its own, so only the person can detect an axis that turns the wrong
    way.
    """
    findings = bench.findings
    bench.ask_before(
        "Step axes: A1 to A6 are turned one after the other by 3 to 10 degrees and back. After each turn you are "
        "asked whether the camera moved as described."
    )
    home_deg = bench.joints_deg()
    for axis in range(6):
        change_deg = bench.clear_change(_visible_change(bench, home_deg, axis))
        bench.ask_before(
            f"A{axis + 1} turns by {change_deg[axis]:+.1f} deg. {_motion_text(bench, home_deg, change_deg)}"
        )
        before_deg = bench.joints_deg()
        turned_deg = bench.go_to(before_deg + change_deg) - before_deg
        off_deg = np.abs(turned_deg - change_deg)
        right = findings.at_most(f"A{axis + 1}: error of its measured turn", off_deg[axis], _TURNED_DEG, "deg")
        others_deg = np.delete(off_deg, axis).max()
        right &= findings.at_most(f"A{axis + 1}: turn of the other axes", others_deg, _OTHERS_DEG, "deg")
        is_as_described = bench.ask_whether(
            f"A{axis + 1} was turned by {turned_deg[axis]:+.2f} deg. "
            f"{_motion_text(bench, before_deg, turned_deg)} "
            "Did you see exactly this?"
        )
        if not (right and is_as_described):
            findings.remedy = (
                f"Compare A{axis + 1} in the arm's description (`arm:` in the rig: axis and sense of rotation), "
                "in the "
                "controller's configuration of corrections and on the arm itself. Do not run any plan."
            )
            return
        bench.go_to(before_deg)


def stopping(bench: Bench) -> None:
    """Stop motions of all axes at several speeds; no axis may turn farther than the driver promises.

    In one motion the axes have different shares of their greatest speeds (`_SHARES`, in turn). So three motions
    together measure each axis at each share. All axes stop together along their path, so the limit for a share is
    that share of `stopping_deg`.
    """
    findings = bench.findings
    findings.remedy = (
        "Find what delays the stop (load of this machine, network, the controller's filters or override), or "
        "let the driver promise a larger angle: set acceleration_deg_s2 in the rig's `motion:` as low as the "
        "controller really brakes."
    )
    bench.ask_before(
        "Step stopping: the arm makes three motions of all axes by at most 15 degrees, is stopped in the middle "
        "of "
        "each, and returns."
    )
    promised_deg, delays_s = bench.opened.robot.stopping_deg(), []
    home_deg = bench.joints_deg()
    for turn in range(len(_SHARES)):
        shares = np.array([_SHARES[(axis + turn) % len(_SHARES)] for axis in range(6)])
        speeds_deg_s, angles_deg = _stopped_once(bench, shares)
        for axis in range(6):
            findings.at_most(
                f"A{axis + 1}: angle to a stop from {speeds_deg_s[axis]:.2f} deg/s",
                angles_deg[axis],
                promised_deg[axis] * shares[axis],
                "deg",
            )
        delays_s.append(float((angles_deg / np.maximum(speeds_deg_s, 1e-6))[shares == 1.0].max()))
        if not all(limit.is_met for limit in findings.limits):
            return
        bench.go_to(home_deg)
    findings.remarks.append(
        "at the greatest speeds of this session, the arm turned before it stopped by at most the angle that it "
        "covers in "
        f"{1e3 * max(delays_s):.0f} ms at full speed; stops from the speeds of plans are not measured, because "
        "these exceed 250 mm/s"
    )


def _stopped_once(bench: Bench, shares: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return speeds [6] at the command to stop, and angles [6] from there to rest, in a motion at these shares of
    the greatest speeds. If the motion ended before the command to stop, it is repeated."""
    robot, clock = bench.opened.robot, bench.opened.clock
    for _ in range(_TRIES):
        begun_deg = bench.joints_deg()
        change_deg = bench.clear_change(_CRUISE_S * shares * bench.velocity_deg_s)
        bench.control.go_on()
        robot.move_to(begun_deg + change_deg)
        deadline = Deadline(clock, 2.0 * _CRUISE_S + 5.0)
        samples: list[tuple[int, NDArray[np.float64]]] = []
        pacing = int(np.argmax(shares))
        while not samples or abs(samples[-1][1] - begun_deg)[pacing] < 0.4 * abs(change_deg[pacing]):
            state = robot.measured()
            if not samples or state.t_ns > samples[-1][0]:
                samples.append((state.t_ns, np.array(state.joints_deg)))
            if state.fault or deadline.has_expired:
                robot.stop()
                raise StepFailedError(f"the arm did not reach its target: {state.fault or 'too slow'}")
            bench.pause(_POLL_S)
        commanded_deg = bench.joints_deg()
        robot.stop()
        at_rest_deg = _at_rest(bench)
        t_ns, then_deg = next(
            (sample for sample in reversed(samples) if samples[-1][0] - sample[0] >= _SPEED_OVER_S * 1e9),
            samples[0],
        )
        elapsed_s = (samples[-1][0] - t_ns) / 1e9
        if elapsed_s > 0.0:
            speeds_deg_s = np.abs(samples[-1][1] - then_deg) / elapsed_s
            if speeds_deg_s[pacing] > 0.5 * shares[pacing] * bench.velocity_deg_s[pacing]:
                return speeds_deg_s, np.abs(at_rest_deg - commanded_deg)
        bench.go_to(begun_deg)
    raise StepFailedError(
        f"{_TRIES} motions had ended before they were stopped: end other programs on this machine"
    )


def _at_rest(bench: Bench) -> NDArray[np.float64]:
    """Return the axes [6] once they have been at rest for a while. Raises StepFailedError if they go on
    turning."""
    deadline = Deadline(bench.opened.clock, _LONGEST_STOP_S)
    last_deg = bench.joints_deg()
    while not deadline.has_expired:
        bench.opened.clock.sleep(_STILL_S)
        now_deg = bench.joints_deg()
        if np.abs(now_deg - last_deg).max() <= _STILL_DEG:
            return now_deg
        last_deg = now_deg
    raise StepFailedError(f"the arm was still turning {_LONGEST_STOP_S:g} s after the command to stop")


def _visible_change(bench: Bench, home_deg: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return a turn [6] of one axis that moves the lens by about _LENS_MM, between _LEAST_DEG and _MOST_DEG."""
    one_deg = np.zeros(6)
    one_deg[axis] = 1.0
    lens_mm = [_base_from_camera(bench, joints)[:3, 3] for joints in (home_deg, home_deg + one_deg)]
    moved_mm = float(np.linalg.norm(lens_mm[1] - lens_mm[0]))
    change_deg: NDArray[np.float64] = one_deg * np.clip(_LENS_MM / max(moved_mm, 1e-3), _LEAST_DEG, _MOST_DEG)
    return change_deg


def _motion_text(bench: Bench, from_deg: NDArray[np.float64], change_deg: NDArray[np.float64]) -> str:
    support = bench.cell.rig.support.base_from_support.matrix()
    return described_motion(
        support, _base_from_camera(bench, from_deg), _base_from_camera(bench, from_deg + change_deg)
    )


def _base_from_camera(bench: Bench, joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    rig = bench.cell.rig
    pose: NDArray[np.float64] = forward(arm_of(rig), joints_deg) @ rig.flange_from_camera.matrix()
    return pose

"""Moves the arm to views and monitors it: its path deviation in motion, its posture at rest.

Frames are proven only while the arm reports that it is at the posture measured after the motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.observer import Control, Held
from coupole.acquisition.opened_cell import OpenedCell
from coupole.clock import Deadline
from coupole.devices import ArmState
from coupole.errors import ArmUnattended, DeviceError, DeviceFault, DeviceLost, PreflightRefused
from coupole.geometry import Transform
from coupole.kinematics import move_duration_s
from coupole.motion.cell_motion import CellMotion
from coupole.motion.itinerary import Itinerary, Visit, arm_of
from coupole.motion.path_deviation import PATH_TOLERANCE_MM, deviation_at_rest_mm
from coupole.motion.path_planner import Joints
from coupole.plan.rig import Rig
from coupole.plan.schedule import ViewPose
from coupole.supervision import ASKS_AFTER_LAPSE_S, LOOK_S

_POLL_S = 0.01
_SPEED_OVER_NS = 30_000_000
"""Least time between the two readings that give the axes' speeds. It is several cycles of any controller."""
_NEWS_S = 1.0
_SPRING_BACK_S = 2.0
"""Time that a pushed arm has to come back by itself."""


class ArmMovedError(Exception):
    """The arm moved during a burst."""


@dataclass(frozen=True)
class SettledPose:
    """The arm's measured state after settling."""

    arm: ArmState
    base_from_camera: Transform


class ArmSupervisor:
    """One session's motions. The operator's stop or a fault of the arm ends every method that waits."""

    def __init__(
        self,
        rig: Rig,
        motion: CellMotion,
        cell: OpenedCell,
        control: Control,
        *,
        stand: Callable[[], None] | None = None,
        tell_lapse: Callable[[str], None] = lambda message: None,
    ) -> None:
        """`stand` waits until a person lets a held session go on. Without `stand`, the error that held a motion is
        raised. `tell_lapse` is called when a motion was braked because this process did not check it.
        """
        self._stand, self._tell_lapse = stand, tell_lapse
        self._rig, self._robot, self._clock, self._control = rig, cell.robot, cell.clock, control
        self._halt = cell.halt
        self._motion, self._paths = rig.motion, motion
        self._arm = arm_of(rig)
        self._settled: SettledPose | None = None
        self._from_deg = np.zeros(6)
        """Joint angles at which the next leg begins."""
        speeds_deg_s = np.array(self._arm.velocity_deg_s)
        self._stopping_s = float((self._robot.stopping_deg() / speeds_deg_s).max())
        """Time within which the arm comes to rest from its highest speed, s. From lower speeds it takes less
        time."""
        self._before: ArmState | None = None
        """An earlier reading during a motion, for the axes' speeds."""
        self._latest_deg_s = np.zeros(6)

    def itinerary(self, views: Sequence[ViewPose]) -> Itinerary:
        """Return the paths to views from the arm's actual posture. Raises PreflightRefused if there is no path."""
        self.begin_here()
        itinerary = self._paths.itinerary(views, self._from_deg.tolist())
        if itinerary.refusals:
            raise PreflightRefused(itinerary.refusals)
        return itinerary

    def way_to(self, view: ViewPose) -> Visit:
        """Return the visit of a view of the plan, from the place at which the next leg begins. It is used if the
        order of the views is not known beforehand. Raises PreflightRefused if there is no path."""
        leg, visit = self._paths.ways.leg(self._from_deg, view), self._paths.ways.visit(view)
        if leg.contact is not None:
            raise PreflightRefused(
                [f"view {view.name}: no path to it was found from where the arm is: {leg.contact}"]
            )
        return Visit(visit.joints_deg, leg)

    def begin_here(self) -> Joints:
        """Let the next leg begin where the arm is now; return the arm's joint angles."""
        self._from_deg = np.array(self._robot.measured().joints_deg)
        return self._from_deg

    def attend(self) -> None:
        """Raise Interrupted after the operator's stop, DeviceFault if the arm is in a fault."""
        self._checked_state()

    def go(self, visit: Visit, meanwhile: Callable[[], None] = lambda: None, speed: float = 1.0) -> SettledPose:
        """Follow the leg of a visit; return the measured pose. `meanwhile` is called every 10 ms. If it raises,
        the error is raised at once, while the arm still moves: the caller stops it. `speed`: share of the arm's
        speeds.

        A motion may be held, or braked because this thread did not look at it. The arm then goes on from where it
        is, along its checked line. After a short lapse it goes on by itself; in all other cases a person must
        confirm."""
        self._settled = None
        path = (self._from_deg, *visit.leg.waypoints)
        from_deg, allowed_path, when = path[0], path, "before it started"
        targets = list(path[1:])
        while targets:
            try:
                self._before = None
                self._keep_to(allowed_path, self._checked_state(), when)
                self._follow(from_deg, targets[0], meanwhile, speed)
                if len(targets) == 1:
                    self._settle()
            except (ArmUnattended, Held, DeviceError) as error:
                self._stand_after(error)
                allowed_path, when = (from_deg, targets[0]), "while it stood"
            else:
                from_deg = targets.pop(0)
                allowed_path, when = (from_deg, *targets), "between two motions"
        self._from_deg = path[-1]
        return self._settled or self._settle()

    def _follow(self, here_deg: Joints, there_deg: Joints, meanwhile: Callable[[], None], speed: float) -> None:
        """One straight motion, watched until the arm is at rest. Raises ArmUnattended if it was braked."""
        self._control.await_word()
        self._control.go_on()
        self._robot.move_to(there_deg, speed)
        self.hurry(move_duration_s(self._arm, here_deg, there_deg) / speed + self._motion.settle_dwell_s)
        while (arm := self._checked_state()).moving:
            self._keep_to((here_deg, there_deg), arm, "during its motion")
            meanwhile()
            self._clock.sleep(_POLL_S, LOOK_S)
        if arm.unattended_s > 0.0:
            raise ArmUnattended(arm.unattended_s)

    def _stand_after(self, error: Exception) -> None:
        """Bring the arm to rest if a motion was braked or must be braked. Then wait for a person, except after a
        short lapse. Other errors are raised.
        """
        lapse_s = error.silent_s if isinstance(error, ArmUnattended) else 0.0
        if self._control.stop.is_set() or not (self.was_held(error) or lapse_s):
            raise error
        self._robot.stop()
        if lapse_s:
            asks = lapse_s >= ASKS_AFTER_LAPSE_S or self._control.hold_pending.is_set()
            self._tell_lapse(str(error) if asks else _may_go_on(lapse_s))
        if lapse_s >= ASKS_AFTER_LAPSE_S:
            if self._stand is None:
                raise error
            self._control.hold(str(error))
        if self._control.hold_pending.is_set():
            if self._stand is None:
                raise error
            self._stand()

    def was_held(self, error: BaseException) -> bool:
        """Tell whether this error came because the session is being held (`Control.stands`). If this is not known
        yet, first switch the lights off and stop the arm."""
        if not isinstance(error, DeviceError):
            return isinstance(error, Held)
        if self._control.awaits_word:
            self._halt()
        return self._control.stands

    def await_return(self, moved_error: ArmMovedError) -> SettledPose:
        """Wait after a push for the arm to spring back by itself; return the newly measured pose.

        Raises DeviceFault if it does not spring back. In that case only a person may say that the arm can move
        again.
        """
        assert self._settled is not None
        deadline = Deadline(self._clock, _SPRING_BACK_S)
        while not deadline.has_expired:
            self._clock.sleep(_POLL_S)
            arm = self._checked_state()
            if not arm.moving and self._off_deg(arm) <= self._motion.still_deg:
                return self._settle()
        raise DeviceFault(
            "robot",
            expected="an arm that stays where it was measured",
            happened=f"{moved_error} and has not come back by itself",
            remedy="Find what pushed it and see that the cell is clear.",
        )

    def heard_at_rest(self) -> int:
        """Return the time of the arm's last reading, on the rig's clock. Raises ArmMovedError if the arm is not at
        its measured posture."""
        assert self._settled is not None
        arm = self._checked_state()
        off_deg = self._off_deg(arm)
        if off_deg > self._motion.still_deg:
            raise ArmMovedError(f"the arm moved by {off_deg:.3f} deg during a burst")
        return arm.t_ns

    def await_news(self) -> ArmState:
        """Wait for one more reading of the arm at rest, so that it covers the burst's last frames."""
        since_ns = self._robot.measured().t_ns
        deadline = Deadline(self._clock, _NEWS_S)
        while self.heard_at_rest() <= since_ns:
            if deadline.has_expired:
                raise DeviceLost(
                    "robot",
                    expected=f"a reading of the arm within {_NEWS_S:g} s of the burst's end",
                    happened="its controller sent none",
                    remedy="Check the controller and its network, then resume the run.",
                )
            self._clock.sleep(_POLL_S)
        return self._robot.measured()

    def hurry(self, seconds: float) -> None:
        """Announce that the caller only waits during these seconds. The clock of a dry run may then run fast."""
        self._clock.hurry(self._clock.now_ns() + int(max(0.0, seconds) * 1e9))

    def _off_deg(self, arm: ArmState) -> float:
        """Return the largest angle between an axis and its settled place."""
        assert self._settled is not None
        return float(np.abs(np.subtract(arm.joints_deg, self._settled.arm.joints_deg)).max())

    def _checked_state(self) -> ArmState:
        self._control.go_on()
        arm = self._robot.measured()
        if arm.fault:
            raise DeviceFault(
                "robot",
                expected="an arm without fault",
                happened=arm.fault,
                remedy="Find the cause and acknowledge it at the robot, then resume the run.",
            )
        return arm

    def _keep_to(self, path: Sequence[Joints], arm: ArmState, when: str) -> None:
        """Stop the arm if it is too far off its path: a stop now would end farther from the path than the
        tolerance."""
        off_mm = deviation_at_rest_mm(
            path,
            np.array(arm.joints_deg),
            self._speeds_deg_s(arm),
            self._paths.bodies.reach_mm,
            self._stopping_s,
        )
        if off_mm <= PATH_TOLERANCE_MM:
            return
        self._robot.stop()
        cause = self._robot.measured().fault  # an emergency stop, too, takes the axes off their common line
        raise DeviceFault(
            "robot",
            expected=f"all of the arm within {PATH_TOLERANCE_MM:g} mm of the path that was checked",
            happened=f"{when} the arm deviated and was stopped; it comes to rest up to {off_mm:.1f} mm off the "
            "path" + (f"; {cause}" if cause else ""),
            remedy="Check the cell; perhaps the controller does not move on straight lines in joint space.",
        )

    def _speeds_deg_s(self, arm: ArmState) -> NDArray[np.float64]:
        """Return the speeds [6] between two readings; 0 before the second reading. The readings are so far apart
        in time that rounding and delays of the network do not matter."""
        before = self._before
        if before is None:
            self._before, self._latest_deg_s = arm, np.zeros(6)
        elif arm.t_ns - before.t_ns >= _SPEED_OVER_NS:
            moved_deg = np.subtract(arm.joints_deg, before.joints_deg)
            self._before, self._latest_deg_s = arm, moved_deg / ((arm.t_ns - before.t_ns) * 1e-9)
        return self._latest_deg_s

    def _settle(self) -> SettledPose:
        arm = self._robot.wait_settled()
        self._settled = SettledPose(arm, arm.base_from_flange @ self._rig.flange_from_camera.matrix())
        return self._settled


def _may_go_on(lapse_s: float) -> str:
    """Return the message about a lapse after which no person is asked."""
    return (
        f"robot: its motion was not checked for {lapse_s:.2f} s (the program stood still, or waited for "
        "something), so it braked on its path. It may move again by itself at any moment: keep clear of it."
    )

"""Brings the arm to views and watches it: on its way within the tube that was found clear, then at rest.

Only an arm that is heard of and stands where it was measured lets frames be proven.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell
from coupole.devices import ArmState, Deadline
from coupole.errors import DeviceFault, DeviceLost, DeviceRefused, Interrupted, PreflightRefused
from coupole.geometry import Transform
from coupole.kinematics import move_duration_s
from coupole.motion.itinerary import Itinerary, Visit, arm_of
from coupole.motion.path_deviation import PATH_TOLERANCE_MM, path_deviation_mm
from coupole.motion.path_planner import Joints
from coupole.plan.schedule import ViewPose
from coupole.preflight.job import Job

_POLL_S = 0.01
_NEWS_S = 1.0


class ArmMovedError(Exception):
    """The arm moved while lights flashed."""


@dataclass(frozen=True)
class SettledPose:
    """Where the arm was measured to settled, still."""

    arm: ArmState
    base_from_camera: Transform


class ArmSupervisor:
    """One session's moves. Every method that waits gives way to the operator's stop and to the arm's faults."""

    def __init__(self, job: Job, cell: OpenedCell, control: Control) -> None:
        self._job, self._robot, self._clock, self._control = job, cell.robot, cell.clock, control
        self._motion = job.cell.rig.motion
        self._arm = arm_of(job.cell.rig)
        self._settled: SettledPose | None = None
        self._from_deg = np.zeros(6)
        """Where the next leg begins."""

    def itinerary(self, views: Sequence[ViewPose]) -> Itinerary:
        """Ways to views from where the arm really stands. Raises PreflightRefused where there is none."""
        self._from_deg = np.array(self._robot.measured().joints_deg)
        found = self._job.motion.itinerary(views, self._from_deg.tolist())
        if found.refusals:
            raise PreflightRefused(found.refusals)
        return found

    def attend(self) -> None:
        """Raise Interrupted if the operator said stop, DeviceFault if the arm is in a fault."""
        self._watched()

    def go(self, visit: Visit, meanwhile: Callable[[], None]) -> SettledPose:
        """Follow the leg of a visit, doing something `meanwhile`; where the arm stands then, measured."""
        self._settled = None
        way = (self._from_deg, *visit.leg.waypoints)
        self._keep_to(way, self._watched(), "before it set out")
        for here_deg, there_deg in pairwise(way):
            self._robot.move_to(there_deg)
            if here_deg is self._from_deg:
                meanwhile()
            self.hurry(move_duration_s(self._arm, here_deg, there_deg) + self._motion.settle_dwell_s)
            while (arm := self._watched()).moving:
                self._keep_to(way, arm, "on its way")
                self._clock.sleep(_POLL_S)
        self._from_deg = way[-1]
        return self._settle()

    def return_to_view(self) -> SettledPose:
        """Bring an arm that was moved back to where it stood; where it stands now, measured anew.

        Raises DeviceRefused where something is in the way.
        """
        assert self._settled is not None
        here_deg = np.array(self._robot.measured().joints_deg)
        there_deg = np.array(self._settled.arm.joints_deg)
        contact = self._job.motion.bodies.contact_on_the_way(here_deg, there_deg)
        if contact is not None:
            raise DeviceRefused(
                "robot",
                expected="a clear way back to the view that the arm was pushed from",
                happened=str(contact),
                remedy="Bring the arm away from it by hand, then resume the run.",
            )
        self._robot.move_to(there_deg)
        return self._settle()

    def heard_at_rest(self) -> int:
        """When the arm was last heard of, on the rig's clock; raises ArmMovedError if it does not stand where
        it was measured."""
        assert self._settled is not None
        arm = self._watched()
        off_deg = float(np.abs(np.subtract(arm.joints_deg, self._settled.arm.joints_deg)).max())
        if off_deg > self._motion.still_deg:
            raise ArmMovedError(f"the arm moved by {off_deg:.3f} deg during a burst")
        return arm.t_ns

    def await_news(self) -> ArmState:
        """Hear once more of the arm at rest, lest it fell silent, or worse, while the last frames were taken."""
        since_ns = self._robot.measured().t_ns
        deadline = Deadline(self._clock, _NEWS_S)
        while self.heard_at_rest() <= since_ns:
            if deadline.expired:
                raise DeviceLost(
                    "robot",
                    expected=f"news of the arm within {_NEWS_S:g} s of the burst's end",
                    happened="its controller is silent",
                    remedy="Check the controller and its network, then resume the run.",
                )
            self._clock.sleep(_POLL_S)
        return self._robot.measured()

    def hurry(self, seconds: float) -> None:
        """For so long there is nothing to do but to watch: a rehearsal's clock may run fast."""
        self._clock.hurry(self._clock.now_ns() + int(max(0.0, seconds) * 1e9))

    def _watched(self) -> ArmState:
        if self._control.stop.is_set():
            raise Interrupted("stopped by the operator; everything proven so far is kept")
        arm = self._robot.measured()
        if arm.fault:
            raise DeviceFault(
                "robot",
                expected="an arm without fault",
                happened=arm.fault,
                remedy="Find the cause and acknowledge it at the robot, then resume the run.",
            )
        return arm

    def _keep_to(self, way: Sequence[Joints], arm: ArmState, when: str) -> None:
        """Stop an arm that is not where its leg was found clear."""
        off_mm = path_deviation_mm(way, np.array(arm.joints_deg), self._job.motion.bodies.reach_mm)
        if off_mm <= PATH_TOLERANCE_MM:
            return
        self._robot.stop()
        raise DeviceFault(
            "robot",
            expected=f"all of the arm within {PATH_TOLERANCE_MM:g} mm of the way that was found clear",
            happened=f"{when} it was up to {off_mm:.1f} mm beside it and has been stopped",
            remedy="See to the cell; the controller may move by other rules than straight lines of its axes.",
        )

    def _settle(self) -> SettledPose:
        arm = self._robot.wait_settled()
        self._settled = SettledPose(arm, arm.base_from_flange @ self._job.cell.rig.flange_from_camera.matrix())
        return self._settled

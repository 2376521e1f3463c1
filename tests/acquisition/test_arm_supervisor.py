"""The watch over the arm, with an arm that reports what the test says."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arms import KR10_R1100_SIXX

from coupole.acquisition import arm_supervisor
from coupole.acquisition.arm_supervisor import ArmMovedError, ArmSupervisor
from coupole.acquisition.observer import Control
from coupole.devices import ArmState
from coupole.errors import DeviceFault, DeviceLost

HERE_DEG = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
THERE_DEG = np.add(HERE_DEG, [0.0, 20.0, 0.0, 0.0, 0.0, 0.0])
REACH_MM = np.full(6, 1000.0)
"""So that an axis off by a mrad moves a point by a mm at most."""
MRAD_DEG = float(np.degrees(1e-3))


class Arm:
    """A `Robot` and its clock: at each reading it has gone on by a tenth of its way, `off_mrad` beside it."""

    def __init__(self, off_mrad: Callable[[float], float] = lambda share: 0.0) -> None:
        self._off_mrad = off_mrad
        self.share, self.t_ns, self.now = 1.0, 1, 0.0
        self.done: list[str] = []
        self.still_deg: Any = HERE_DEG
        self.silent, self.fault = False, ""
        self.unattended_s: list[float] = []
        """Lapses to come: at each, the arm brakes half-way."""

    def now_ns(self) -> int:
        return int(self.now * 1e9)

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        self.now += seconds

    def hurry(self, until_ns: int) -> None:
        """No matter here."""

    def stopping_deg(self) -> Any:
        return np.zeros(6)

    def move_to(self, joints_deg: Any, speed: float = 1.0) -> None:
        self.done.append("move")
        self.from_deg, self.to_deg, self.share = self.still_deg, joints_deg, 0.0

    def measured(self) -> ArmState:
        self.t_ns += not self.silent
        if self.share >= 1.0:
            return self._state(self.still_deg, moving=False)
        if self.share >= 0.5 and self.unattended_s:
            self.still_deg = self.from_deg + 0.5 * (self.to_deg - self.from_deg)
            self.share = 1.0
            return replace(self._state(self.still_deg, moving=False), unattended_s=self.unattended_s.pop())
        self.share += 0.1
        joints_deg = self.from_deg + min(1.0, self.share) * (self.to_deg - self.from_deg)
        joints_deg = np.add(joints_deg, [MRAD_DEG * self._off_mrad(self.share), 0, 0, 0, 0, 0])
        if self.share >= 1.0:
            self.still_deg = self.to_deg
        return self._state(joints_deg, moving=True)

    def wait_settled(self) -> ArmState:
        return self._state(self.still_deg, moving=False)

    def stop(self) -> None:
        self.done.append("stop")

    def _state(self, joints_deg: Any, *, moving: bool) -> ArmState:
        return ArmState(tuple(joints_deg), np.eye(4), self.t_ns, moving, self.fault)


@pytest.fixture
def supervised(monkeypatch: pytest.MonkeyPatch) -> Callable[[Arm], ArmSupervisor]:
    monkeypatch.setattr(arm_supervisor, "arm_of", lambda rig: KR10_R1100_SIXX)
    flange = SimpleNamespace(matrix=lambda: np.eye(4))
    rig = SimpleNamespace(motion=SimpleNamespace(settle_dwell_s=0.1, still_deg=0.01), flange_from_camera=flange)

    def supervise(arm: Arm) -> ArmSupervisor:
        found = SimpleNamespace(legs=[], refusals=[])
        bodies = SimpleNamespace(reach_mm=REACH_MM)
        motion = SimpleNamespace(bodies=bodies, itinerary=lambda views, start_deg: found)
        job: Any = SimpleNamespace(cell=SimpleNamespace(rig=rig), motion=motion)
        cell: Any = SimpleNamespace(robot=arm, clock=arm, halt=lambda: arm.done.append("halt"))
        supervisor = ArmSupervisor(job.cell.rig, job.motion, cell, Control())
        supervisor.itinerary([])
        return supervisor

    return supervise


@pytest.mark.parametrize(("lapse_s", "asks"), [(0.4, False), (6.0, True)])
def test_nobody_is_sent_to_the_cell_while_the_arm_may_move_on_by_itself(
    supervised: Supervise, lapse_s: float, asks: bool
) -> None:
    arm, told, stood = Arm(), list[str](), list[str]()
    arm.unattended_s = [lapse_s]
    supervisor = supervised(arm)
    supervisor._tell_lapse = told.append
    supervisor._control.can_stand = True

    def stand() -> None:
        stood.append("stood")
        supervisor._control.hold_pending.clear()

    supervisor._stand = stand
    supervisor.go(VISIT)
    assert arm.done == ["move", "stop", "move"]
    (text,) = told
    assert ("Check that the cell is clear, then continue" in text) == asks == bool(stood)
    assert ("It may move again by itself at any moment: keep clear of it" in text) != asks


@pytest.mark.parametrize(("late_s", "done"), [(0.0, ["move"]), (2.0, ["move", "halt"])])
def test_on_a_machine_so_busy_that_it_may_have_been_frozen_all_is_halted_before_that_is_waited_for(
    supervised: Supervise, late_s: float, done: list[str]
) -> None:
    arm = Arm()
    supervisor = supervised(arm)

    def fails() -> None:
        supervisor._control.pulse_s = time.monotonic() - late_s
        raise DeviceLost("robot", expected="an answer", happened="none came", remedy="None.")

    with pytest.raises(DeviceLost):
        supervisor.go(VISIT, meanwhile=fails)
    assert arm.done == done


VISIT: Any = SimpleNamespace(leg=SimpleNamespace(waypoints=[THERE_DEG]))
Supervise = Callable[[Arm], ArmSupervisor]


def test_an_arm_on_its_path_arrives(supervised: Supervise) -> None:
    arm = Arm()
    pose = supervised(arm).go(VISIT)
    assert pose.arm.joints_deg == tuple(THERE_DEG)
    assert arm.done == ["move"]


def test_each_leg_begins_where_the_one_before_it_ended(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.go(VISIT)
    aside: Any = SimpleNamespace(leg=SimpleNamespace(waypoints=[np.add(THERE_DEG, [30.0, 0, 0, 0, 0, 0])]))
    assert supervisor.go(aside).arm.joints_deg == tuple(aside.leg.waypoints[0])


def test_what_is_looked_at_meanwhile_ends_a_motion_at_once(supervised: Supervise) -> None:
    arm = Arm()
    looks = iter([None, None])
    with pytest.raises(StopIteration):
        supervised(arm).go(VISIT, meanwhile=lambda: next(looks))
    assert arm.share < 0.5, "long before it has arrived"


@pytest.mark.parametrize("off_mm", [10.5, 14.0, -14.0, 19.0])
def test_an_arm_more_than_10_mm_beside_its_path_is_stopped(supervised: Supervise, off_mm: float) -> None:
    arm = Arm(lambda share: off_mm if share > 0.5 else 0.0)
    with pytest.raises(DeviceFault, match=f"during its motion .* comes to rest up to {abs(off_mm):.1f} mm"):
        supervised(arm).go(VISIT)
    assert arm.done == ["move", "stop"]


def test_what_took_the_arm_off_its_path_is_told_if_the_controller_knows_it(supervised: Supervise) -> None:
    class Braked(Arm):
        def stop(self) -> None:
            super().stop()
            self.fault = "emergency stop"

    arm = Braked(lambda share: 14.0 if share > 0.5 else 0.0)
    with pytest.raises(DeviceFault, match="off the path; emergency stop"):
        supervised(arm).go(VISIT)


def test_an_arm_9_mm_beside_its_path_goes_on(supervised: Supervise) -> None:
    arm = Arm(lambda share: 9.0 if 0.3 < share < 0.9 else 0.0)
    supervised(arm).go(VISIT)
    assert arm.done == ["move"]


def test_an_arm_that_is_not_where_its_path_begins_does_not_start(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    arm.still_deg = np.add(HERE_DEG, [14 * MRAD_DEG, 0, 0, 0, 0, 0])
    with pytest.raises(DeviceFault, match=r"before it started .* up to 14\.0 mm"):
        supervisor.go(VISIT)
    assert "move" not in arm.done


def test_a_fault_in_motion_ends_the_motion(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)

    def fail(share: float) -> float:
        arm.fault = "emergency stop" if share > 0.5 else ""
        return 0.0

    arm._off_mrad = fail
    with pytest.raises(DeviceFault, match="emergency stop"):
        supervisor.go(VISIT)


def test_a_fault_of_an_arm_at_rest_is_told(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.attend()
    arm.fault = "protective stop"
    with pytest.raises(DeviceFault, match="protective stop"):
        supervisor.attend()


@pytest.mark.parametrize(("off_deg", "moved"), [(0.009, False), (0.011, True), (-0.011, True)])
def test_an_arm_at_rest_may_be_off_by_what_the_rig_calls_still(
    supervised: Supervise, off_deg: float, moved: bool
) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.go(VISIT)
    arm.still_deg = np.add(THERE_DEG, [0, 0, 0, 0, 0, off_deg])
    if not moved:
        supervisor.heard_at_rest()
        return
    with pytest.raises(ArmMovedError, match=r"moved by 0\.011 deg"):
        supervisor.heard_at_rest()


def test_news_are_newer_than_the_moment_at_which_they_are_asked_for(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.go(VISIT)
    before_ns = arm.t_ns
    assert supervisor.await_news().t_ns > before_ns + 1


def test_an_arm_that_says_nothing_more_is_lost(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.go(VISIT)
    arm.silent = True
    with pytest.raises(DeviceLost, match="its controller sent none"):
        supervisor.await_news()


def test_an_arm_that_was_pushed_and_springs_back_is_measured_anew_and_never_driven(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.go(VISIT)
    arm.still_deg = np.add(THERE_DEG, [0.004, 0, 0, 0, 0, 0])
    assert supervisor.await_return(ArmMovedError("it moved")).arm.joints_deg == tuple(arm.still_deg)
    assert arm.done == ["move"]


def test_an_arm_that_stays_pushed_is_a_fault_and_never_driven(supervised: Supervise) -> None:
    arm = Arm()
    supervisor = supervised(arm)
    supervisor.go(VISIT)
    arm.still_deg = np.add(THERE_DEG, [0.02, 0, 0, 0, 0, 0])
    with pytest.raises(DeviceFault, match="has not come back by itself"):
        supervisor.await_return(ArmMovedError("it moved"))
    assert arm.done == ["move"]

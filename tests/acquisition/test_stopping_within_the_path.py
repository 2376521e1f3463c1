"""An arm that leaves its path is stopped so early that it comes to rest where the path was found clear."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from places import REPO

from coupole.acquisition.arm_supervisor import ArmSupervisor
from coupole.acquisition.observer import Control
from coupole.devices import ArmState
from coupole.errors import DeviceFault
from coupole.kinematics import forward
from coupole.motion.itinerary import Visit, arm_of
from coupole.motion.path_deviation import PATH_TOLERANCE_MM, deviation_at_rest_mm
from coupole.motion.path_planner import Leg
from coupole.preflight.job import Job, read_job

STOPPING_S = 0.4
POLL_S = 0.01


class Drifting:
    """Clock and arm in one: axis 3 moves as it should, axis 1 drifts at a constant speed. After `stop` both go on
    for the whole stopping time at their speed: the worst that `stopping_deg` allows."""

    def __init__(self, job: Job, drift_deg_s: float) -> None:
        self.arm = arm_of(job.cell.rig)
        self.home_deg = np.array(job.cell.rig.motion.home_joints_deg)
        self.speeds_deg_s = np.array([drift_deg_s, 0.0, -2.0, 0.0, 0.0, 0.0])
        self.now_s, self.stopped_s = 0.0, np.inf
        self.moving = False

    def stopping_deg(self) -> NDArray[np.float64]:
        return STOPPING_S * np.array(self.arm.velocity_deg_s)

    def joints_deg(self) -> NDArray[np.float64]:
        rest_s = self.stopped_s + STOPPING_S
        joints: NDArray[np.float64] = self.home_deg + self.speeds_deg_s * min(self.now_s, rest_s)
        return joints

    def measured(self) -> ArmState:
        joints = self.joints_deg()
        a, b, c, d, e, f = joints.tolist()
        pose = forward(self.arm, joints)
        return ArmState((a, b, c, d, e, f), pose, int(self.now_s * 1e9), self.moving)

    def move_to(self, joints_deg: NDArray[np.float64], speed: float = 1.0) -> None:
        self.moving = True

    def stop(self) -> None:
        self.stopped_s = self.now_s

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        self.now_s += seconds
        assert self.now_s < 20.0, "it was never stopped"

    def now_ns(self) -> int:
        return int(self.now_s * 1e9)

    def hurry(self, until_ns: int) -> None:
        """Time passes by `sleep` only."""


@pytest.fixture(scope="module")
def job() -> Job:
    return read_job(REPO / "configs/plans/demo.yaml")


def supervised(job: Job, drift_deg_s: float) -> tuple[Drifting, float]:
    """Drive an arm that drifts; returns it and its greatest deviation when it is at rest, mm."""
    arm = Drifting(job, drift_deg_s)
    goal = arm.home_deg - np.array((0.0, 0.0, 60.0, 0.0, 0.0, 0.0))
    cell: Any = SimpleNamespace(robot=arm, clock=arm, halt=lambda: None)
    supervisor = ArmSupervisor(job.cell.rig, job.motion, cell, Control())
    supervisor._from_deg = arm.home_deg
    with pytest.raises(DeviceFault, match="comes to rest"):
        supervisor.go(Visit(goal, Leg((goal,), 3.0)))
    arm.now_s += STOPPING_S
    reach_mm = job.motion.bodies.reach_mm
    return arm, deviation_at_rest_mm([arm.home_deg, goal], arm.joints_deg(), np.zeros(6), reach_mm, 0.0)


@pytest.mark.parametrize("drift_deg_s", [0.1, 0.3, 0.6])
def test_a_drifting_arm_comes_to_rest_within_the_tolerance(job: Job, drift_deg_s: float) -> None:
    _, at_rest_mm = supervised(job, drift_deg_s)
    growth_mm = np.radians(drift_deg_s) * job.motion.bodies.reach_mm[0] * 4 * POLL_S
    assert PATH_TOLERANCE_MM - growth_mm <= at_rest_mm <= PATH_TOLERANCE_MM + growth_mm


def test_an_arm_that_drifts_too_fast_is_stopped_as_soon_as_its_speed_is_known(job: Job) -> None:
    arm, _ = supervised(job, 2.0)
    assert arm.stopped_s <= 5 * POLL_S

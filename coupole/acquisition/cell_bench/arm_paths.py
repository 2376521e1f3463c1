"""Paths that are planned and shown before the arm is driven along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.cell_bench.bench_requests import Posture, ViewOf
from coupole.errors import InputError
from coupole.kinematics import Arm, limit_violations, link_frames
from coupole.motion.cell_motion import CellMotion
from coupole.motion.itinerary import Visit, arm_of
from coupole.motion.path_planner import Joints, PathPlanner
from coupole.plan.cell import Cell
from coupole.preflight.job import Job, read_job

_SHOWN_EVERY_DEG = 5.0
_MOST_SHOWN = 200


@dataclass(frozen=True)
class ShownPath:
    """A collision-free path that begins where the arm was when the path was planned."""

    id: str
    to: str
    start_deg: Joints
    visit: Visit
    motion: CellMotion
    """The bodies that the path does not touch."""


class ArmPaths:
    """Plans paths of a cell's arm. The support carries a job's object, or nothing."""

    def __init__(self, cell: Cell, job: Job | None) -> None:
        self._cell, self._job = cell, job
        self.arm = arm_of(cell.rig)
        self.motion = job.motion if job else CellMotion(cell, np.zeros((0, 3, 3)), [], "fastest")
        self._jobs: dict[tuple[str, int], Job] = {}

    def plan(self, number: str, to: str | ViewOf | Posture, start_deg: Joints) -> ShownPath:
        """Plan a path to home, to park, to a view or to joint angles. Raises InputError if there is no path, or if
        the plan is for another cell or object."""
        if isinstance(to, ViewOf):
            job = self.job_of(Path(to.plan))
            view = next((pose for pose in job.schedule.views if pose.name == to.view), None)
            if view is None:
                names = ", ".join(pose.name for pose in job.schedule.views[:20])
                raise InputError(f"{to.plan}: expected one of its views ({names}), found {to.view!r}")
            itinerary = job.motion.itinerary([view], start_deg.tolist())
            (visit,) = itinerary.visits
            if visit is None:
                raise InputError("\n".join(itinerary.refusals))
            return ShownPath(number, f"view {to.view}", start_deg, visit, job.motion)
        goal_deg, name = self._posture(to)
        visit = self._straight_to(goal_deg, name, start_deg)
        return ShownPath(number, name, start_deg, visit, self.motion)

    def figures(self, path: ShownPath) -> dict[str, Any]:
        """Return a path as a console shows it, with values of JSON only."""
        corners = [path.start_deg, *path.visit.leg.waypoints]
        along = shown_postures(corners)
        return {
            "path": path.id,
            "to": path.to,
            "duration_s": round(path.visit.leg.duration_s + self._cell.rig.motion.settle_dwell_s, 3),
            "waypoints_deg": np.round(corners, 6).tolist(),
            "joints_deg": np.round(along, 4).tolist(),
            "links_mm": links_mm(self.arm, along),
            "camera_mm": self._cameras_mm(along),
        }

    def base_from_camera(self, joints_deg: Joints) -> NDArray[np.float64]:
        """Return the camera's pose, computed from the rig."""
        pose: NDArray[np.float64] = link_frames(self.arm, joints_deg)[-1] @ self._flange_from_camera
        return pose

    @property
    def _flange_from_camera(self) -> NDArray[np.float64]:
        return self._cell.rig.flange_from_camera.matrix()

    def _cameras_mm(self, joints_deg: NDArray[np.float64]) -> list[list[float]]:
        poses = link_frames(self.arm, joints_deg)[:, -1] @ self._flange_from_camera
        positions_mm: list[list[float]] = np.round(poses[:, :3, 3], 2).tolist()
        return positions_mm

    def _posture(self, to: str | Posture) -> tuple[Joints, str]:
        motion = self._cell.rig.motion
        if isinstance(to, Posture):
            return np.array(to.joints_deg), "joint angles"
        if to == "home":
            return np.array(motion.home_joints_deg), to
        if motion.park_joints_deg is None:
            raise InputError(
                f"{self._cell.document.path}: the rig has no park; give `park_joints_deg` in `motion:`"
            )
        return np.array(motion.park_joints_deg), to

    def _straight_to(self, goal_deg: Joints, name: str, start_deg: Joints) -> Visit:
        if violation := limit_violations(self.arm, goal_deg):
            raise InputError(f"{name}: {violation}")
        planner = PathPlanner(self.arm, self.motion.bodies, [self._cell.rig.motion.home_joints_deg])
        leg = planner.leg(start_deg, goal_deg)
        if leg.contact is not None:
            raise InputError(f"{name}: no path to it was found from the arm's present place: {leg.contact}")
        return Visit(goal_deg, leg)

    def job_of(self, plan: Path) -> Job:
        """Return the plan's job in this cell. Raises InputError if its object is not the bench's object."""
        if not plan.is_absolute():
            raise InputError(f"{plan}: expected an absolute path")
        try:
            key = str(plan), plan.stat().st_mtime_ns
        except OSError as error:
            raise InputError(f"{plan}: cannot be read: {error.strerror}") from error
        except ValueError as error:  # no name of a file, as one with a NUL
            raise InputError(f"{str(plan)!r}: cannot be read: {error}") from error
        if key not in self._jobs:
            self._jobs = {key: read_job(plan, self._cell.document.path)}
        job = self._jobs[key]
        if self._job is not None and not np.array_equal(job.shape.corners_mm, self._job.shape.corners_mm):
            raise InputError(
                f"{plan}: its object, or the object's place, differs from the plan with which the bench was begun"
            )
        return job


def shown_postures(corners_deg: Sequence[Joints]) -> NDArray[np.float64]:
    """Postures [n, 6] along straight motions, so close together that a picture of them is continuous."""
    longest_deg = sum(float(np.abs(b - a).max()) for a, b in pairwise(corners_deg))
    step_deg = max(_SHOWN_EVERY_DEG, longest_deg / _MOST_SHOWN)
    postures_deg = [np.asarray(corners_deg[0], dtype=np.float64)]
    for a, b in pairwise(corners_deg):
        count = max(1, int(np.ceil(np.abs(b - a).max() / step_deg)))
        postures_deg += [a + (b - a) * (k + 1) / count for k in range(count)]
    return np.array(postures_deg)


def links_mm(arm: Arm, joints_deg: NDArray[np.float64]) -> list[Any]:
    """Return origins [..., 8, 3] for postures [..., 6], in the base frame: of the base, the six links and the
    flange."""
    origins_mm: list[Any] = np.round(link_frames(arm, joints_deg)[..., :3, 3], 2).tolist()
    return origins_mm

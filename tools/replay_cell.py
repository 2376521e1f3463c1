"""The cell in python-fcl: an independent check of motions that Coupole's own checker has accepted.

Joint chains are from the data sheets, profiles are from ruckig, and bodies are triangle meshes and fcl's own
shapes. Nothing of `coupole.kinematics`, `motion.collisions` or `motion.path_planner` is used, except the sizes of
the arm's capsules if its meshes are not available.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray
from ruckig import InputParameter, Ruckig, Trajectory

from coupole.motion.bodies import Capsule, capsules_of
from coupole.plan.rig import KeepOutSphere
from coupole.plan.rig_devices import described_arm
from coupole.preflight.job import Job

STEP_S = 0.004


@dataclass(frozen=True)
class Figures:
    """The checker's own parameters of an arm."""

    joints_mm: tuple[tuple[float, float, float], ...]
    axes: tuple[tuple[int, int, int], ...]
    """Origins and axes of the joints at angles of 0, each in the frame of the joint before."""
    flange_mm: tuple[float, float, float]
    flange_axis: tuple[int, int, int]
    """Step from link 6 to the flange: its position (`flange_mm`), and the axis about which it is rotated by 90
    deg."""
    top_deg_s: tuple[float, ...]
    """Highest axis speeds, before the rig's fraction."""
    has_jerk: bool = True
    """False: trapezoidal speed profiles."""


def _of_ur(top_deg_s: float, d1: float, a2: float, a3: float, d4: float, d5: float, d6: float) -> Figures:
    """Return figures from Universal Robots' table of Denavit-Hartenberg parameters, mm."""
    joints = ((0, 0, d1), (0, 0, 0), (a2, 0, 0), (a3, 0, 0), (0, -d4, 0), (0, 0, -d5))
    axes = ((0, 0, 1), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, 0, -1), (0, -1, 0))
    return Figures(joints, axes, (0, -d6, 0), (1, 0, 0), (top_deg_s,) * 6, has_jerk=False)


ARMS = {
    "KR10 R1100 sixx": Figures(
        ((0, 0, 400), (25, 0, 0), (560, 0, 0), (0, 0, 35), (515, 0, 0), (80, 0, 0)),
        ((0, 0, -1), (0, 1, 0), (0, 1, 0), (-1, 0, 0), (0, 1, 0), (-1, 0, 0)),
        (0, 0, 0),
        (0, 1, 0),
        (300, 225, 225, 381, 311, 492),
    ),
    "UR5e": _of_ur(179.9, 162.5, -425.0, -392.2, 133.3, 99.7, 99.6),
    "UR10e": _of_ur(120.0, 180.7, -612.7, -571.55, 174.15, 119.85, 116.55),
}
"""Figures of arms, by the names of the robot descriptions."""
KR10 = ARMS["KR10 R1100 sixx"]
_DISK_MM, _SHELL_MM = 50.0, 4
FLANGE = 7
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Touch:
    """Two bodies that overlap."""

    body: str
    other: str
    joints_deg: tuple[float, ...]


def link_poses(joints_deg: Floats, arm: Figures = KR10) -> Floats:
    """[n, 8, 4, 4] poses of base, six links and flange, in the base frame."""
    poses = np.tile(np.eye(4), (len(joints_deg), 8, 1, 1))
    for k, (origin_mm, axis) in enumerate(zip(arm.joints_mm, arm.axes, strict=True)):
        step = np.tile(np.eye(4), (len(joints_deg), 1, 1))
        step[:, :3, :3] = _rotations(np.array(axis, dtype=float), np.radians(joints_deg[:, k]))
        step[:, :3, 3] = origin_mm
        poses[:, k + 1] = poses[:, k] @ step
    flange = np.eye(4)
    flange[:3, :3] = _rotations(np.array(arm.flange_axis, dtype=float), np.array([np.pi / 2]))[0]
    flange[:3, 3] = arm.flange_mm
    poses[:, FLANGE] = poses[:, 6] @ flange
    return poses


def _rotations(axis: Floats, angles: Floats) -> Floats:
    """[n, 3, 3] by Rodrigues' formula."""
    cross = np.cross(np.eye(3), axis)
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    rotations: Floats = np.eye(3) + sines * cross + (1.0 - cosines) * (cross @ cross)
    return rotations


def arm_of(job: Job) -> Figures:
    """The checker's parameters of the arm of a job's rig."""
    arm_description = described_arm(job.cell.rig)
    assert arm_description is not None
    return ARMS[arm_description.name]


def motion(job: Job, start_deg: Floats, goal_deg: Floats) -> Floats:
    """Return [n, 6] the straight motion from rest to rest in steps of 4 ms, by ruckig."""
    way_deg = goal_deg - start_deg
    is_moving = np.abs(way_deg) > 0
    if not is_moving.any():
        return goal_deg[None]
    limits, arm = job.cell.rig.motion, arm_of(job)
    top_deg_s = limits.speed_fraction * np.array(arm.top_deg_s)
    way = float(np.abs(way_deg).max())
    profile = InputParameter(1)
    profile.current_position, profile.target_position = [0.0], [1.0]
    profile.max_velocity = [float(np.min(top_deg_s[is_moving] / np.abs(way_deg[is_moving])))]
    profile.max_acceleration = [limits.acceleration_deg_s2 / way]
    if arm.has_jerk:
        profile.max_jerk = [limits.jerk_deg_s3 / way]
    course = Trajectory(1)
    Ruckig(1).calculate(profile, course)
    times = np.append(np.arange(0.0, course.duration, STEP_S), course.duration)
    shares = np.array([course.at_time(float(t))[0][0] for t in times])
    return start_deg + shares[:, None] * way_deg


class ReplayCell:
    """A job's cell in fcl; `touches` lists overlapping bodies."""

    def __init__(self, job: Job, meshes: Path | None) -> None:
        rig = job.cell.rig
        self._support_from_base = np.linalg.inv(rig.support.base_from_support.matrix())
        tool = [Capsule(body.name, FLANGE, body.from_mm, body.to_mm, body.radius_mm) for body in rig.tool]
        arm_description = described_arm(rig)
        assert arm_description is not None
        self._arm = arm_of(job)
        links = _links_of_meshes(meshes) if meshes else _solids(capsules_of(arm_description))
        self._moving = [*links, *_solids(tool)]
        self._around = self._surroundings(job)
        least_apart = 2 if meshes else 3  # capsules of links that are two apart overlap by construction
        self._own = [
            (i, j)
            for i, (_, link, _) in enumerate(self._moving)
            for j, (_, other_link, _) in enumerate(self._moving[:i])
            if abs(min(link, 6) - min(other_link, 6)) >= (least_apart if max(link, other_link) < FLANGE else 3)
        ]

    @staticmethod
    def _surroundings(job: Job) -> list[tuple[str, Any]]:
        rig = job.cell.rig
        base_from_support = rig.support.base_from_support.matrix()
        leds_mm = trimesh.transform_points(job.cell.leds.positions_mm, np.linalg.inv(base_from_support))
        radius_mm = float(np.linalg.norm(leds_mm, axis=1).min())
        top = float((leds_mm[:, 2] / np.linalg.norm(leds_mm, axis=1)).max())
        shell = trimesh.creation.icosphere(subdivisions=_SHELL_MM, radius=radius_mm)
        shell.update_faces((shell.vertices[shell.faces][..., 2] <= top * radius_mm).all(axis=1))
        disk = fcl.Cylinder(rig.support.diameter_mm / 2, _DISK_MM)
        around = [
            ("the dome", fcl.CollisionObject(_bvh(shell.vertices, shell.faces))),
            ("the support", fcl.CollisionObject(disk, fcl.Transform(np.array((0.0, 0.0, -_DISK_MM / 2))))),
        ]
        for keep_out in rig.keep_out:
            if isinstance(keep_out, KeepOutSphere):
                shape, center = fcl.Sphere(keep_out.radius_mm), np.array(keep_out.center_mm)
            else:
                low, high = np.array(keep_out.min_mm), np.array(keep_out.max_mm)
                shape, center = fcl.Box(*(high - low)), (low + high) / 2
            around.append((f"keep-out `{keep_out.name}`", fcl.CollisionObject(shape, fcl.Transform(center))))
        if len(corners := job.shape.corners_mm):
            around.append(("the object", fcl.CollisionObject(_bvh(*_triangle_soup(corners)))))
        return around

    def touches(self, joints_deg: Floats) -> list[Touch]:
        """Return pairs of bodies that overlap anywhere on [n, 6]; each once, at its first overlap."""
        touch_of_pair: dict[tuple[str, str], Touch] = {}
        for joints, links in zip(
            joints_deg, self._support_from_base @ link_poses(joints_deg, self._arm), strict=True
        ):
            for _, link, solid in self._moving:
                solid.setTransform(fcl.Transform(links[link][:3, :3], links[link][:3, 3]))
            pairs = [
                *(
                    (name, obstacle, a, b)
                    for name, link, a in self._moving
                    if link
                    for obstacle, b in self._around
                ),
                *(
                    (self._moving[i][0], self._moving[j][0], self._moving[i][2], self._moving[j][2])
                    for i, j in self._own
                ),
            ]
            for name, obstacle, a, b in pairs:
                if (name, obstacle) not in touch_of_pair and fcl.collide(
                    a, b, fcl.CollisionRequest(), fcl.CollisionResult()
                ):
                    touch_of_pair[name, obstacle] = Touch(name, obstacle, tuple(joints.tolist()))
        return list(touch_of_pair.values())


def _links_of_meshes(folder: Path) -> list[tuple[str, int, Any]]:
    links = []
    for link in range(7):
        mesh: Any = trimesh.load(folder / (f"link_{link}.stl" if link else "base_link.stl"), force="mesh")
        scale = 1000.0 if mesh.extents.max() < 10.0 else 1.0
        solid = fcl.CollisionObject(_bvh(mesh.vertices * scale, mesh.faces))
        links.append((f"link {link}" if link else "base", link, solid))
    return links


def _solids(capsules: Sequence[Capsule]) -> list[tuple[str, int, Any]]:
    """Return capsules as meshes."""
    solids = []
    for capsule in capsules:
        start, end = np.array(capsule.start_mm, dtype=float), np.array(capsule.end_mm, dtype=float)
        length = float(np.linalg.norm(end - start))
        mesh = trimesh.creation.capsule(height=length, radius=capsule.radius_mm, count=[24, 24])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        if length > 0:
            mesh.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), (end - start) / length))
        mesh.apply_translation((start + end) / 2)
        solids.append((capsule.body, capsule.link, fcl.CollisionObject(_bvh(mesh.vertices, mesh.faces))))
    return solids


def _triangle_soup(corners: Floats) -> tuple[Floats, NDArray[np.int64]]:
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def _bvh(vertices: Floats, faces: NDArray[np.int64]) -> Any:
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces))
    model.endModel()
    return model

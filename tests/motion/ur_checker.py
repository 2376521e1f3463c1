"""Universal Robots' arms as python-fcl sees them: capsules read from the arms' files, on the stand-in's own
chain."""

from __future__ import annotations

from typing import Any

import fcl
import numpy as np
from numpy.typing import NDArray
from places import REPO
from ruamel.yaml import YAML

from coupole.geometry import apply, inverse, transform
from coupole.motion.bodies import Capsule
from sim.devices import ur_arm
from sim.devices.kuka_kinematics import turn
from sim.devices.ur_arm import UrModel

Floats = NDArray[np.float64]
BASE_FROM_SUPPORT = transform((200, 0, 1450), (0, 0, 180))
TOOL = (Capsule("camera", 7, (0, 0, 20), (0, 0, 100), 60), Capsule("cables", 7, (0, 0, 0), (0, -60, 40), 50))
BOX_MM = (300.0, 200.0, 250.0)


def moved(model: UrModel, joints_deg: Floats) -> list[Floats]:
    """Of the base and the six links what brings them from all angles 0 to these: a product of turns about the axes
    that the stand-in's chain has with all angles 0."""
    _, origins_mm, axes = ur_arm.chain(model, [0.0] * 6)
    moves = [np.eye(4)]
    for angle_deg, origin_mm, axis in zip(joints_deg, origins_mm, axes, strict=True):
        step = np.eye(4)
        step[:3, :3] = turn(axis.tolist(), float(angle_deg))
        step[:3, 3] = origin_mm - step[:3, :3] @ origin_mm
        moves.append(moves[-1] @ step)
    return moves


class Checker:
    """The capsules of the arm's file, and of the tool, as python-fcl's own."""

    def __init__(self, model: UrModel) -> None:
        self._model = model
        data: Any = YAML(typ="safe", pure=True).load(REPO / f"configs/robots/{model}.yaml")
        at_mm = np.vstack([np.zeros(3), np.cumsum([joint["origin_mm"] for joint in data["joints"]], axis=0)])
        flange = ur_arm.flange_pose(model, [0.0] * 6)
        self.bodies: dict[str, list[tuple[int, Floats, float, Any]]] = {}
        for link in data["links"]:
            for part in link["capsules"]:
                ends = np.array([part["from_mm"], part["to_mm"]]) + at_mm[link["link"]]
                self._add(link["name"], link["link"], ends, part["radius_mm"])
        for body in TOOL:
            self._add(body.body, 6, apply(flange, [body.start_mm, body.end_mm]), body.radius_mm)
        self.box = fcl.CollisionObject(fcl.Box(*BOX_MM), self._transform(transform((0, 0, BOX_MM[2] / 2))))

    def _add(self, name: str, link: int, ends_mm: Floats, radius_mm: float) -> None:
        length_mm = max(float(np.linalg.norm(ends_mm[1] - ends_mm[0])), 1e-6)
        solid = fcl.CollisionObject(fcl.Capsule(radius_mm, length_mm))
        self.bodies.setdefault(name, []).append((link, ends_mm, radius_mm, solid))

    @staticmethod
    def _transform(pose: Floats) -> Any:
        return fcl.Transform(np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3]))

    def place(self, joints_deg: Floats) -> None:
        moves = inverse(BASE_FROM_SUPPORT) @ np.array(moved(self._model, joints_deg))
        for parts in self.bodies.values():
            for link, ends_mm, _, solid in parts:
                start, end = apply(moves[link], ends_mm)
                along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
                aside = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
                pose = np.eye(4)
                if np.linalg.norm(along) > 0.5:
                    aside /= np.linalg.norm(aside)
                    pose[:3, :3] = np.column_stack([aside, np.cross(along, aside), along])
                pose[:3, 3] = (start + end) / 2
                solid.setTransform(self._transform(pose))

    def distance_mm(self, body: str, other: str) -> float:
        """Negative where the two overlap."""
        solids = [solid for *_, solid in self.bodies[body]]
        others = [self.box] if other == "the object" else [solid for *_, solid in self.bodies[other]]
        pairs = [(a, b) for a in solids for b in others]
        if any(fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()) for a, b in pairs):
            return -1.0
        return min(fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult()) for a, b in pairs)


def to_segment_mm(points: Floats, start: Floats, end: Floats) -> Floats:
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
    away: Floats = np.linalg.norm(points - start - share[:, None] * along, axis=1)
    return away

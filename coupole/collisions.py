"""Bodies of the cell and the distances between them: what the arm must not touch, and by how much.

The arm is a set of capsules (a segment and a radius) that enclose the vendor's link meshes; the camera and an
allowance for its cables are capsules too. Around it stand the object (its scanned mesh), the support disk, the
dome seen from inside, and keep-out volumes. All distances are conservative: what is sampled (capsule axes,
mesh surfaces, motions) is taken closer by what could lie between the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.geometry import Transform, apply, inverse
from coupole.kinematics import Arm, link_frames

AXIS_STEP_MM = 20.0
"""Spacing of the points on a capsule's axis."""
MESH_STEP_MM = 6.0
"""Spacing of the points on an object's surface."""
SWEEP_STEP_MM = 10.0
"""No point of the arm moves farther than this between two checked places of a motion."""


@dataclass(frozen=True)
class Capsule:
    """All points within `radius_mm` of a segment, in the frame of one link (0 is the base, 7 the flange)."""

    body: str
    link: int
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    radius_mm: float


ARM_CAPSULES = (
    Capsule("base", 0, (-93, 1, 133), (-93, 1, 93), 144),
    Capsule("base", 0, (3, 0, 148), (21, 0, 36), 130),
    Capsule("link 1", 1, (22, 57, -17), (27, 61, -17), 119),
    Capsule("link 1", 1, (-10, 4, -124), (15, 1, -132), 127),
    Capsule("link 1", 1, (18, -60, -14), (24, -63, -20), 119),
    Capsule("link 2", 2, (-2, -4, -1), (65, -6, 13), 113),
    Capsule("link 2", 2, (379, -2, 12), (210, -2, 5), 100),
    Capsule("link 2", 2, (478, 0, 2), (561, -1, -1), 135),
    Capsule("link 3", 3, (0, 0, -12), (-13, 2, 6), 90),
    Capsule("link 3", 3, (34, 0, 47), (64, 0, 18), 83),
    Capsule("link 4", 4, (147, 0, 0), (223, 0, 0), 73),
    Capsule("link 4", 4, (344, -6, 9), (282, -7, 0), 85),
    Capsule("link 4", 4, (413, 1, 0), (511, 0, 1), 71),
    Capsule("link 5", 5, (0, 2, 0), (40, 1, 0), 52),
    Capsule("link 6", 6, (-7, 0, -1), (-7, 0, -1), 23),
)
"""KR10 R1100 sixx, mm, in the links' frames: fitted round the collision meshes of kuka_experimental
(ros-industrial), radii rounded up; a test checks that they enclose every vertex where the meshes are at hand."""


@dataclass(frozen=True)
class Contact:
    """Two bodies that come too close."""

    body: str
    other: str
    distance_mm: float
    """Conservative; negative where they overlap."""
    required_mm: float

    def __str__(self) -> str:
        how = f"{self.distance_mm:.0f} mm from" if self.distance_mm > 0 else "inside"
        return f"{self.body} would be {how} {self.other}; {self.required_mm:g} mm must be kept"


@dataclass(frozen=True)
class Clearances:
    """Distances that must be kept, mm."""

    object_mm: float = 50.0
    support_mm: float = 10.0
    dome_mm: float = 20.0
    self_mm: float = 0.0
    keep_out_mm: float = 0.0


@dataclass(frozen=True)
class Surroundings:
    """What stands round the arm, in the support frame."""

    base_from_support: Transform
    support_radius_mm: float
    dome_radius_mm: float
    dome_top_deg: float
    """Elevation above which the dome is open."""
    object_points_mm: NDArray[np.float64]
    """[n, 3] on the object's surface, none farther than MESH_STEP_MM from what lies between them."""
    keep_out_spheres: tuple[tuple[str, tuple[float, float, float], float], ...] = ()
    keep_out_boxes: tuple[tuple[str, tuple[float, float, float], tuple[float, float, float]], ...] = ()


_SELF_PAIRS = tuple(
    (moving, fixed)
    for moving, against in {
        "link 3": ("base",),
        "link 4": ("base", "link 1"),
        "link 5": ("base", "link 1", "link 2"),
        "link 6": ("base", "link 1", "link 2"),
        "tool": ("base", "link 1", "link 2", "link 3"),
    }.items()
    for fixed in against
)
"""Bodies of the arm that can meet; neighbours in the chain are kept apart by the joints' limits."""
_FIXED_TO_BASE = ("base",)
REACH_MM = (1600.0, 1500.0, 1000.0, 420.0, 420.0, 250.0)
"""Farthest that any point of arm and tool can be from axis 1 to 6 (links stretched out, tool of 300 mm)."""
_RESOLUTION_MM = 2.0
_FAR_MM = 400.0


class CellBodies:
    """The arm among its surroundings; `margins` is everything else's foundation."""

    def __init__(
        self,
        arm: Arm,
        surroundings: Surroundings,
        tool: Sequence[Capsule],
        clearances: Clearances | None = None,
    ) -> None:
        self._arm, self._around = arm, surroundings
        self._clearances = clearances or Clearances()
        self._capsules = (*ARM_CAPSULES, *tool)
        self._points = [_axis_points(c) for c in self._capsules]
        self._support_from_base = inverse(surroundings.base_from_support)
        names = {c.body for c in self._capsules}
        self._tool_names = tuple(c.body for c in tool)
        self._pairs = [
            (a, fixed)
            for moving, fixed in _SELF_PAIRS
            for a in (dict.fromkeys(self._tool_names) if moving == "tool" else (moving,))
            if a in names
        ]

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self._around.object_points_mm) if len(self._around.object_points_mm) else None

    @cached_property
    def _box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        points = self._around.object_points_mm
        return points.min(axis=0), points.max(axis=0)

    def _axes_in_base(self, joints_deg: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """For each capsule its axis points [n, m, 3] in the base frame."""
        frames = link_frames(self._arm, joints_deg)
        return [
            points @ frames[:, c.link, :3, :3].swapaxes(-1, -2) + frames[:, c.link, None, :3, 3]
            for c, points in zip(self._capsules, self._points, strict=True)
        ]

    def margins(self, joints_deg: ArrayLike) -> dict[tuple[str, str], NDArray[np.float64]]:
        """For each pair of bodies, distance minus what must be kept [n], of joint angles [n, 6]; mm, never more
        than the true value."""
        joints = np.atleast_2d(np.asarray(joints_deg, dtype=np.float64))
        axes = self._axes_in_base(joints)
        keep, around = self._clearances, self._around
        found: dict[tuple[str, str], NDArray[np.float64]] = {}

        def note(body: str, other: str, margin: NDArray[np.float64]) -> None:
            key = (body, other)
            found[key] = np.minimum(found[key], margin) if key in found else margin

        for capsule, axis in zip(self._capsules, axes, strict=True):
            if capsule.body in _FIXED_TO_BASE:
                continue
            slack = capsule.radius_mm + _axis_slack(capsule)
            points = apply(self._support_from_base, axis)
            note(capsule.body, "the support", self._to_support(points) - slack - keep.support_mm)
            note(capsule.body, "the dome", self._to_dome(points) - slack - keep.dome_mm)
            if self._tree is not None:
                note(capsule.body, "the object", self._to_object(points) - slack - MESH_STEP_MM - keep.object_mm)
            for name, center, radius in around.keep_out_spheres:
                distance = np.linalg.norm(points - np.array(center), axis=-1).min(axis=-1) - radius
                note(capsule.body, f"keep-out `{name}`", distance - slack - keep.keep_out_mm)
            for name, low, high in around.keep_out_boxes:
                distance = _to_box(points, np.array(low), np.array(high)).min(axis=-1)
                note(capsule.body, f"keep-out `{name}`", distance - slack - keep.keep_out_mm)
        for body, other in self._pairs:
            for i, first in enumerate(self._capsules):
                for j, second in enumerate(self._capsules):
                    if (first.body, second.body) == (body, other):
                        apart = np.linalg.norm(axes[i][:, :, None] - axes[j][:, None], axis=-1).min(axis=(1, 2))
                        slack = first.radius_mm + second.radius_mm + _axis_slack(first) + _axis_slack(second)
                        note(body, f"the arm's {other}", apart - slack - keep.self_mm)
        return found

    def contacts(self, joints_deg: ArrayLike) -> list[Contact]:
        """What comes too close in one place [6] of the arm, nearest first."""
        close = sorted((float(m[0]), pair) for pair, m in self.margins(joints_deg).items() if m[0] < 0)
        return [self._contact(pair, margin) for margin, pair in close]

    def contact_on_the_way(self, from_deg: ArrayLike, to_deg: ArrayLike) -> Contact | None:
        """The first contact found on a straight motion in joint space, None if there is none.

        A stretch is clear if, in its middle, every pair is farther apart than the arm can move from there to the
        stretch's ends; other stretches are halved. So nothing between samples is missed.
        """
        start, end = np.asarray(from_deg, dtype=np.float64), np.asarray(to_deg, dtype=np.float64)
        sweep_mm = float(np.radians(np.abs(end - start)) @ np.array(REACH_MM))
        middles, half = np.array([0.5]), 0.5
        while len(middles):
            moved_mm = sweep_mm * half
            margins = self.margins(start + middles[:, None] * (end - start))
            tightest = np.full(len(middles), np.inf)
            for (body, other), margin in margins.items():
                both_move = other.startswith("the arm's")
                limit = margin - (2 if both_move else 1) * moved_mm
                if np.any(margin < 0) or (moved_mm < _RESOLUTION_MM and np.any(limit < 0)):
                    return self._contact((body, other), float(margin.min()))
                tightest = np.minimum(tightest, limit)
            half /= 2
            unclear = middles[tightest < 0]
            middles = np.concatenate([unclear - half, unclear + half])
        return None

    def _contact(self, pair: tuple[str, str], margin: float) -> Contact:
        keep = self._clearances
        required = {
            "the object": keep.object_mm,
            "the support": keep.support_mm,
            "the dome": keep.dome_mm,
        }.get(pair[1], keep.self_mm if pair[1].startswith("the arm's") else keep.keep_out_mm)
        return Contact(pair[0], pair[1], margin + required, required)

    def _to_support(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Smallest distance [n] of points [n, m, 3] to the disk; below it counts as inside."""
        outside = np.linalg.norm(points[..., :2], axis=-1) - self._around.support_radius_mm
        height = points[..., 2]
        beside = np.hypot(np.maximum(outside, 0.0), height)
        distance: NDArray[np.float64] = np.where(outside > 0, beside, height).min(axis=-1)
        return distance

    def _to_dome(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Smallest distance [n] of points [n, m, 3] to the dome, from inside; negative outside."""
        around = self._around
        radius = np.linalg.norm(points, axis=-1)
        out = np.linalg.norm(points[..., :2], axis=-1)
        top = np.radians(around.dome_top_deg)
        rim = around.dome_radius_mm * np.array([np.cos(top), np.sin(top)])
        through_the_top = np.hypot(out - rim[0], points[..., 2] - rim[1])
        open_above = points[..., 2] > np.tan(top) * out
        distance: NDArray[np.float64] = np.where(open_above, through_the_top, around.dome_radius_mm - radius).min(
            axis=-1
        )
        return distance

    def _to_object(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Smallest distance [n] of points [n, m, 3] to the object's surface points (far away: to its box)."""
        flat = points.reshape(-1, 3)
        distance = _to_box(flat, *self._box)
        near = distance < _FAR_MM
        if near.any():
            distance[near] = self._tree.query(flat[near])[0]
        least: NDArray[np.float64] = distance.reshape(points.shape[:-1]).min(axis=-1)
        return least


def _axis_points(capsule: Capsule) -> NDArray[np.float64]:
    start, end = np.array(capsule.start_mm, dtype=float), np.array(capsule.end_mm, dtype=float)
    count = int(np.ceil(np.linalg.norm(end - start) / AXIS_STEP_MM)) + 1
    points: NDArray[np.float64] = start + np.linspace(0, 1, count)[:, None] * (end - start)
    return points


def _axis_slack(capsule: Capsule) -> float:
    """How much closer than its axis points a capsule's axis can be, mm."""
    points = _axis_points(capsule)
    return float(np.linalg.norm(points[1] - points[0]) / 2) if len(points) > 1 else 0.0


def _to_box(
    points: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance [...] of points [..., 3] to an axis-parallel box; negative inside."""
    beyond = np.maximum(low - points, points - high)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    distance: NDArray[np.float64] = np.where(outside > 0, outside, beyond.max(axis=-1))
    return distance


def surface_points(corners_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [n, 3] on a mesh of corners [triangles, 3, 3], so dense that no point of its surface is farther than
    MESH_STEP_MM from one of them."""
    edge_mm, cell_mm = MESH_STEP_MM, MESH_STEP_MM / 3
    triangles = corners_mm
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
        fine = edges <= edge_mm
        done.append(triangles[fine].reshape(-1, 3))
        a, b, c = np.moveaxis(triangles[~fine], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    points = np.concatenate(done) if done else np.zeros((0, 3))
    _, first = np.unique(np.floor(points / cell_mm).astype(np.int64), axis=0, return_index=True)
    kept: NDArray[np.float64] = points[first]
    return kept

"""Bodies of the arm and its tool: their shapes as spheres in the frames of its links, and how far they reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.kinematics import JOINT_AXES, Arm, joint_origins_mm, link_frames
from coupole.motion.sphere_tree import Floats, Spheres, spheres_of, surface_points
from coupole.plan.link_meshes import LINKS, link_mesh_path

FLANGE = 7
LINK_MESH_STEP_MM = 12.0
"""Spacing of the points on a link's mesh, when meshes are asked for instead of capsules."""
_METRES_BELOW = 10.0
"""A link mesh no larger than this is in metres, as ROS has it; otherwise in mm."""


@dataclass(frozen=True)
class Capsule:
    """All points within `radius_mm` of a segment, in the frame of one link (0 is the base, 7 the flange)."""

    body: str
    link: int
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    radius_mm: float


@dataclass(frozen=True, eq=False)
class Body:
    """Something rigid: spheres in the frame of one link."""

    name: str
    link: int
    spheres: Spheres


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


def bodies_of_capsules(capsules: Sequence[Capsule]) -> list[Body]:
    """One body for each name, in order."""
    bodies = []
    for name in dict.fromkeys(c.body for c in capsules):
        own = [c for c in capsules if c.body == name]
        ends = np.array([[c.start_mm, c.end_mm] for c in own], dtype=np.float64)
        bodies.append(Body(name, own[0].link, spheres_of(ends, np.array([c.radius_mm for c in own], dtype=float))))
    return bodies


def bodies_of_meshes(folder: Path) -> list[Body]:
    """The base and the six links from `base_link.stl` and `link_1.stl` to `link_6.stl`, in the links' frames, in
    metres or mm. Raises InputError where one of them cannot be read."""
    bodies = []
    for link in range(LINKS):
        points = surface_points(link_corners(folder, link), LINK_MESH_STEP_MM)
        spheres = Spheres(points, np.full(len(points), LINK_MESH_STEP_MM))
        bodies.append(Body(f"link {link}" if link else "base", link, spheres))
    return bodies


def link_corners(folder: Path, link: int) -> Floats:
    """Triangles [n, 3, 3] of a link's mesh, mm. Raises InputError."""
    import trimesh

    path = link_mesh_path(folder, link)
    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh")
    except Exception as error:  # whatever trimesh raises, the file is not a mesh to us
        raise InputError(f"{path}: expected the mesh of link {link}; {error}") from error
    corners: Floats = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    if len(corners) == 0 or not np.isfinite(corners).all():
        raise InputError(f"{path}: expected the mesh of link {link}; it has no triangles, or no finite ones")
    return corners * (1000.0 if np.ptp(corners) < _METRES_BELOW else 1.0)


def reach_mm(arm: Arm, body: Body, from_link: int = 0) -> Floats:
    """[6] farthest that any point of a body can be from each axis; 0 for axes that do not move it against
    `from_link`. Links are taken as stretched out, so no posture reaches farther."""
    centers, link = body.spheres.centers_mm, body.link
    if link == FLANGE:
        frames = link_frames(arm, np.zeros(6))
        centers, link = apply(np.linalg.inv(frames[6]) @ frames[FLANGE], centers), 6
    origins = np.array(joint_origins_mm(arm))
    farthest = float((np.linalg.norm(centers, axis=1) + body.spheres.radii_mm).max())
    reach = np.zeros(6)
    for k in range(from_link, link):
        across = [i for i in range(3) if i != JOINT_AXES[k]]
        if k == link - 1:
            reach[k] = (np.linalg.norm(centers[:, across], axis=1) + body.spheres.radii_mm).max()
        else:
            beyond = np.linalg.norm(origins[k + 2 : link], axis=1).sum()
            reach[k] = np.linalg.norm(origins[k + 1, across]) + beyond + farthest
    return reach


def part_apart(
    arm: Arm, body: Body, other: Body, postures_deg: Sequence[Sequence[float]], by_mm: float
) -> Body | None:
    """The part of a body whose spheres are more than `by_mm` from another in all of some postures; None if there
    is none."""
    apart = np.ones(len(body.spheres.radii_mm), dtype=bool)
    for joints_deg in postures_deg:
        frames = link_frames(arm, joints_deg)
        at, others = (apply(frames[b.link], b.spheres.centers_mm) for b in (body, other))
        distances_mm = np.linalg.norm(at[:, None] - others, axis=2) - other.spheres.radii_mm
        apart &= distances_mm.min(axis=1) > body.spheres.radii_mm + by_mm
    if not apart.any():
        return None
    return Body(body.name, body.link, Spheres(body.spheres.centers_mm[apart], body.spheres.radii_mm[apart]))

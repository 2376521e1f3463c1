"""Bodies of the arm and its tool: spheres in the frames of the links, and greatest distances of the bodies from
the axes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.intake.input_files import InputFiles
from coupole.joint_chain import FLANGE
from coupole.kinematics import Arm, link_frames
from coupole.motion.remembered import Remembered
from coupole.motion.sphere_tree import Floats, Spheres, spheres_of, surface_points
from coupole.plan.arm_description import ArmDescription
from coupole.plan.link_meshes import LINKS, link_mesh_path

LINK_MESH_STEP_MM = 12.0
"""Spacing of the points on a link's mesh, if meshes are used instead of capsules."""
_METRES_BELOW = 10.0
"""A link mesh of at most this size is taken to be in metres (the ROS convention), a larger one in mm."""

_LARGEST_MM = 5000.0
_PARTS: Remembered[NDArray[np.bool_]] = Remembered(most=16)


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
    """A rigid body: spheres in the frame of one link."""

    name: str
    link: int
    spheres: Spheres


def capsules_of(arm: ArmDescription) -> tuple[Capsule, ...]:
    """Return the arm's capsules from the base outwards, in the order of its description."""
    return tuple(
        Capsule(link.name, link.link, part.from_mm, part.to_mm, part.radius_mm)
        for link in arm.links
        for part in link.capsules
    )


def bodies_of_capsules(capsules: Sequence[Capsule]) -> list[Body]:
    """Return one body for each name, in order."""
    bodies = []
    for name in dict.fromkeys(c.body for c in capsules):
        body_capsules = [c for c in capsules if c.body == name]
        ends = np.array([[c.start_mm, c.end_mm] for c in body_capsules], dtype=np.float64)
        bodies.append(
            Body(
                name,
                body_capsules[0].link,
                spheres_of(ends, np.array([c.radius_mm for c in body_capsules], dtype=float)),
            )
        )
    return bodies


def bodies_of_meshes(folder: Path, arm: ArmDescription, files: InputFiles | None = None) -> list[Body]:
    """Return the base and the six links from `base_link.stl` and `link_1.stl` to `link_6.stl`, in the links'
    frames, in
        metres or mm, with the names of the arm's description. Raises InputError if a file cannot be read."""
    names = {link.link: link.name for link in arm.links}
    bodies = []
    for link in range(LINKS):
        points = surface_points(link_corners(folder, link, files), LINK_MESH_STEP_MM)
        spheres = Spheres(points, np.full(len(points), LINK_MESH_STEP_MM))
        bodies.append(Body(names.get(link, "base"), link, spheres))
    return bodies


def link_corners(folder: Path, link: int, files: InputFiles | None = None) -> Floats:
    """Return triangles [n, 3, 3] of a link's mesh, mm, read from `files` if they are given. Raises InputError."""
    import trimesh

    path = link_mesh_path(folder, link)
    try:
        data = io.BytesIO((files or InputFiles()).read_bytes(path))
        mesh: Any = trimesh.load(data, file_type="stl", process=False, force="mesh")
    except Exception as error:  # any exception of trimesh means that the file is not a readable mesh
        raise InputError(f"{path}: expected the mesh of link {link}; {error}") from error
    corners: Floats = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    if len(corners) == 0 or not np.isfinite(corners).all():
        raise InputError(f"{path}: expected the mesh of link {link}; it has no triangles, or no finite ones")
    corners = corners * (1000.0 if np.ptp(corners) < _METRES_BELOW else 1.0)
    if np.abs(corners).max() > _LARGEST_MM:
        far_mm = np.abs(corners).max()
        raise InputError(
            f"{path}: expected the mesh of link {link} in its own frame, metres or mm; it reaches {far_mm:.3g} mm"
        )
    return corners


def reach_mm(arm: Arm, body: Body, from_link: int = 0) -> Floats:
    """Return [6], the greatest distance of any point of a body from each axis. It is 0 for axes that do not move
    the body relative to `from_link`. It is computed for stretched links, so it is a bound for all postures."""
    centers, link = body.spheres.centers_mm, body.link
    if link == FLANGE:
        frames = link_frames(arm, np.zeros(6))
        centers, link = apply(np.linalg.inv(frames[6]) @ frames[FLANGE], centers), 6
    origins = np.array(arm.chain.origins_mm)
    farthest = float((np.linalg.norm(centers, axis=1) + body.spheres.radii_mm).max())
    reach = np.zeros(6)
    for k in range(from_link, link):
        across = [i for i in range(3) if i != arm.chain.axis_numbers[k]]
        if k == link - 1:
            reach[k] = (np.linalg.norm(centers[:, across], axis=1) + body.spheres.radii_mm).max()
        else:
            beyond = np.linalg.norm(origins[k + 2 : link], axis=1).sum()
            reach[k] = np.linalg.norm(origins[k + 1, across]) + beyond + farthest
    return reach


def part_apart(
    arm: Arm, body: Body, other_body: Body, postures_deg: Sequence[Sequence[float]], by_mm: float
) -> Body | None:
    """Return the part of a body whose spheres are more than `by_mm` from another body in all of some postures;
    None if there is none."""
    apart = _PARTS.result(
        (arm, body.link, *body.spheres, other_body.link, *other_body.spheres, np.array(postures_deg), by_mm),
        lambda: _are_apart(arm, body, other_body, postures_deg, by_mm),
    )
    if not apart.any():
        return None
    return Body(body.name, body.link, Spheres(body.spheres.centers_mm[apart], body.spheres.radii_mm[apart]))


def _are_apart(
    arm: Arm, body: Body, other_body: Body, postures_deg: Sequence[Sequence[float]], by_mm: float
) -> NDArray[np.bool_]:
    """Return [spheres of the body], True for spheres that are apart."""
    apart = np.ones(len(body.spheres.radii_mm), dtype=bool)
    for joints_deg in postures_deg:
        frames = link_frames(arm, joints_deg)
        at, other_centers_mm = (apply(frames[b.link], b.spheres.centers_mm) for b in (body, other_body))
        distances_mm = np.linalg.norm(at[:, None] - other_centers_mm, axis=2) - other_body.spheres.radii_mm
        apart &= distances_mm.min(axis=1) > body.spheres.radii_mm + by_mm
    return apart

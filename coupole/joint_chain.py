"""A chain of six revolute joints: frames of its links, and inverse kinematics in closed form.

A chain is data: for each joint, its origin in the frame of the previous link, and the coordinate axis of rotation.
A link's frame has its origin in the joint and, with all angles 0, is parallel to the base frame. Two structures
are solved; nearly all arms with six joints have one of them. `structure_of` identifies a chain's structure and
verifies it with the forward kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.geometry import Transform, inverse
from coupole.wrist_lengths import WristLengths

Floats: TypeAlias = NDArray[np.float64]
Vector: TypeAlias = tuple[float, float, float]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]

FLANGE = 7
"""Number of the flange's frame. Frame 0 is the base's, 1 to 6 are the links'."""
_WRIST_NUDGE_RAD = 1e-3
_MEETS_MM, _ROUNDING = 1e-6, 1e-9
_PROOF_DEG = ((20.0, -50.0, 65.0, 25.0, 40.0, -70.0), (-110.0, -130.0, -75.0, -35.0, -55.0, 100.0))


@dataclass(frozen=True)
class JointChain:
    """Joints 1 to 6 and the flange."""

    origins_mm: tuple[Vector, ...]
    """Origin of each joint in the frame of the previous link."""
    axes: tuple[Axis, ...]
    """Axis of rotation of each joint, right-handed, in its link's frame."""
    link_6_from_flange: tuple[tuple[float, ...], ...]
    """4x4 matrix, row by row, mm."""

    @cached_property
    def axis_numbers(self) -> tuple[int, ...]:
        """0 for x, 1 for y, 2 for z."""
        return tuple("xyz".index(axis[1]) for axis in self.axes)

    @cached_property
    def senses(self) -> tuple[float, ...]:
        """Senses of the axes: 1 for a positive coordinate axis of the joint's frame, -1 for a negative one."""
        return tuple(-1.0 if axis[0] == "-" else 1.0 for axis in self.axes)


@dataclass(frozen=True)
class SphericalWrist:
    """Ortho-parallel basis and spherical wrist (OPW)."""

    lengths: WristLengths
    opw_from_flange: tuple[tuple[float, ...], ...]
    """4x4 transform from the paper's flange, whose z axis is along axis 6, to the chain's flange."""

    def theta(self, joints_deg: ArrayLike) -> Floats:
        """Return the paper's angles [..., 6] in radians."""
        joints = np.asarray(joints_deg, dtype=np.float64)
        theta: Floats = np.radians(
            np.where(self.lengths.flip_axes, -joints, joints) - np.asarray(self.lengths.offsets_deg)
        )
        return theta


@dataclass(frozen=True)
class ParallelAxes:
    """Axes 2, 3 and 4 are parallel. Axis 1 meets 2, 4 meets 5 and 5 meets 6, each at right angles. These are
    Universal Robots' arms.

    Lengths and angles are Denavit and Hartenberg's in their standard form, with alpha 90, 0, 0, 90, -90 and 0
    degrees. The base is at the intersection of axes 1 and 2, and the last frame at the intersection of axes 5 and
    6, so that d1 and d6 are 0 (Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms",
    2013, has the same chain).
    """

    a2_mm: float
    a3_mm: float
    d4_mm: float
    d5_mm: float
    senses: tuple[float, ...]
    zeros_rad: tuple[float, ...]
    """Zeros of the angles: theta = sense * joint angle + zero."""
    base_from_first: tuple[tuple[float, ...], ...]
    last_from_flange: tuple[tuple[float, ...], ...]

    def theta(self, joints_deg: ArrayLike) -> Floats:
        """Return Denavit and Hartenberg's angles [..., 6] in radians."""
        joints = np.radians(np.asarray(joints_deg, dtype=np.float64))
        theta: Floats = np.array(self.senses) * joints + np.array(self.zeros_rad)
        return theta


Structure: TypeAlias = SphericalWrist | ParallelAxes


def link_frames(chain: JointChain, joints_deg: ArrayLike) -> Floats:
    """Return `base_from_link` [..., 8, 4, 4] for joint angles [..., 6]: base, the six links, the flange."""
    joints = np.radians(np.array(chain.senses) * np.asarray(joints_deg, dtype=np.float64))
    frames = np.zeros((*joints.shape[:-1], 8, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    cosines, sines = np.cos(joints), np.sin(joints)
    for k, (origin_mm, axis) in enumerate(zip(chain.origins_mm, chain.axis_numbers, strict=True)):
        step = np.zeros((*joints.shape[:-1], 4, 4))
        c, s = cosines[..., k], sines[..., k]
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step[..., range(4), range(4)] = 1.0
        step[..., i, i], step[..., j, j], step[..., i, j], step[..., j, i] = c, c, -s, s
        step[..., :3, 3] = origin_mm
        frames[..., k + 1, :, :] = frames[..., k, :, :] @ step
    frames[..., FLANGE, :, :] = frames[..., 6, :, :] @ np.array(chain.link_6_from_flange)
    return frames


def shoulder_mm(chain: JointChain) -> Floats:
    """Return the point [3] of axis 1 that is nearest to joint 2, in the base frame."""
    first, direction = np.array(chain.origins_mm[0]), _directions(chain)[0]
    along: Floats = first + (np.array(chain.origins_mm[1]) @ direction) * direction
    return along


@lru_cache(maxsize=32)
def structure_of(chain: JointChain) -> Structure | None:
    """Return the chain's solvable structure; None if it has neither."""
    for structure in (_spherical_wrist(chain), _parallel_axes(chain)):
        if structure is not None and all(_solves(structure, chain, joints_deg) for joints_deg in _PROOF_DEG):
            return structure
    return None


def branches(chain: JointChain, base_from_flange: Transform) -> list[Floats]:
    """Return at most eight sets of joint angles [6] in degrees that reach the pose, wrapped to +-180. Limits are
    ignored.

    Raises ValueError for a chain that `structure_of` does not know.
    """
    structure = structure_of(chain)
    if structure is None:
        raise ValueError(
            "a chain with neither a spherical wrist nor three parallel axes has no closed solution here"
        )
    return _branches(structure, base_from_flange)


def _branches(structure: Structure, base_from_flange: Transform) -> list[Floats]:
    if isinstance(structure, SphericalWrist):
        return _branches_of_spherical_wrist(structure, base_from_flange)
    return _branches_of_parallel_axes(structure, base_from_flange)


def _solves(structure: Structure, chain: JointChain, joints_deg: tuple[float, ...]) -> bool:
    """True if all solutions for a pose reproduce it and include the joint angles from which the pose was
    computed."""
    pose = link_frames(chain, joints_deg)[FLANGE]
    branches_deg = np.array(_branches(structure, pose)).reshape(-1, 6)
    off_deg = np.abs((branches_deg - joints_deg + 180.0) % 360.0 - 180.0).max(axis=1, initial=0.0)
    there = link_frames(chain, branches_deg)[:, FLANGE]
    return len(branches_deg) > 0 and bool(np.abs(there - pose).max() < 1e-6) and bool(off_deg.min() < 1e-6)


def _directions(chain: JointChain) -> Floats:
    """Return [6, 3], the axes of rotation with all angles 0."""
    return np.array(chain.senses)[:, None] * np.eye(3)[list(chain.axis_numbers)]


# -- spherical wrist ------------------------------------------------------------------------------------------


def _spherical_wrist(chain: JointChain) -> SphericalWrist | None:
    """Return the lengths of a chain if it may have this structure, read off with all angles 0. The structure is
    not proven yet."""
    if chain.axis_numbers[:3] != (2, 1, 1) or chain.axis_numbers[4] != 1:
        return None
    at, turns = np.cumsum(np.array(chain.origins_mm), axis=0), _directions(chain)
    wrist = np.array((at[4, 0], at[3, 1], at[4, 2]))
    upper, fore = at[2] - at[1], wrist - at[2]
    along = turns[3] * (1.0 if fore @ turns[3] >= 0.0 else -1.0)
    hand = turns[5] * (1.0 if along @ turns[5] >= 0.0 else -1.0)
    upper_rad, fore_rad, hand_rad = (float(np.arctan2(v[0], v[2])) for v in (upper, along, hand))
    flange = np.eye(4)
    flange[:3, 3] = at[5]
    flange = flange @ np.array(chain.link_6_from_flange)
    c4_mm = float((flange[:3, 3] - wrist) @ hand)
    base_from_opw = np.eye(4)
    c, s = np.cos(hand_rad), np.sin(hand_rad)
    base_from_opw[:3, :3] = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    base_from_opw[:3, 3] = wrist + c4_mm * hand
    positive = (turns[0][2], turns[1][1], turns[2][1], turns[3] @ along, turns[4][1], turns[5] @ hand)
    offsets = (0.0, -upper_rad, upper_rad - fore_rad, 0.0, fore_rad - hand_rad, 0.0)
    lengths = WristLengths(
        a1_mm=float(at[1, 0]),
        a2_mm=float(fore @ np.array((along[2], 0.0, -along[0]))),
        b_mm=float(wrist[1]),
        c1_mm=float(at[1, 2]),
        c2_mm=float(np.hypot(upper[0], upper[2])),
        c3_mm=float(fore @ along),
        c4_mm=c4_mm,
        offsets_deg=tuple(float(np.degrees(offset)) + 0.0 for offset in offsets),
        flip_axes=tuple(bool(sense < 0.0) for sense in positive),
    )
    return SphericalWrist(lengths, _rows(inverse(base_from_opw) @ flange))


@lru_cache(maxsize=32)
def _solver(wrist: SphericalWrist) -> Any:
    import py_opw_kinematics as opw

    new_model: Any = opw.KinematicModel  # its stub asks for tuples of six, which these fields are
    model = new_model(
        a1=wrist.lengths.a1_mm,
        a2=wrist.lengths.a2_mm,
        b=wrist.lengths.b_mm,
        c1=wrist.lengths.c1_mm,
        c2=wrist.lengths.c2_mm,
        c3=wrist.lengths.c3_mm,
        c4=wrist.lengths.c4_mm,
        offsets=wrist.lengths.offsets_deg,
        flip_axes=wrist.lengths.flip_axes,
    )
    return opw.Robot(model, degrees=True), inverse(np.array(wrist.opw_from_flange))


def _raw_branches(wrist: SphericalWrist, base_from_opw: Transform) -> Floats:
    """Return [8, 6] in degrees, wrapped to +-180; NaN for a branch that does not exist. Limits are ignored."""
    from py_opw_kinematics import RigidTransform

    branches_deg: Floats = _solver(wrist)[0].reach(RigidTransform.from_matrix(base_from_opw)).joints[0]
    return branches_deg + 0.0  # makes -0 to 0


def _branches_of_spherical_wrist(wrist: SphericalWrist, base_from_flange: Transform) -> list[Floats]:
    """Return the existing branches [6], and the branches that py-opw-kinematics misses when the wrist is
    stretched."""
    base_from_opw = base_from_flange @ _solver(wrist)[1]
    raw = _raw_branches(wrist, base_from_opw)
    branches_deg = [branch for branch in raw if not np.isnan(branch).any()]
    if len(branches_deg) == len(raw):
        return branches_deg
    # Turned a little about the wrist centre the same wrist position is reached by the same A1, A2, A3.
    nudged_pose = np.array(base_from_opw, dtype=np.float64)
    wrist_mm = nudged_pose[:3, 3] - wrist.lengths.c4_mm * nudged_pose[:3, 2]
    c, s = np.cos(_WRIST_NUDGE_RAD), np.sin(_WRIST_NUDGE_RAD)
    nudged_pose[:3, :3] = nudged_pose[:3, :3] @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    nudged_pose[:3, 3] = wrist_mm + wrist.lengths.c4_mm * nudged_pose[:3, 2]
    stretched_deg = wrist.lengths.offsets_deg[4] * (-1.0 if wrist.lengths.flip_axes[4] else 1.0)
    for branch in _raw_branches(wrist, nudged_pose):
        first, _, _ = wrist.theta(branch)[:3]
        fore = wrist.theta(branch)[1:3].sum()
        turn = _forearm_rotation(first, fore).T @ base_from_opw[:3, :3]
        if not turn[2, 2] >= 1.0 - 1e-12:  # also where the branch is NaN
            continue
        a6_deg = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
        a6_deg = -a6_deg if wrist.lengths.flip_axes[5] else a6_deg
        branches_deg.append(np.array([*branch[:3], 0.0, stretched_deg, a6_deg]))
    return branches_deg


def _forearm_rotation(first: float, fore: float) -> Floats:
    """Return the 3x3 rotation Rz(first) Ry(fore), the forearm's orientation by OPW's angles (Brandstoetter 2014,
    eq. 1 to 5)."""
    c1, s1, c, s = np.cos(first), np.sin(first), np.cos(fore), np.sin(fore)
    return np.array([[c1 * c, -s1, c1 * s], [s1 * c, c1, s1 * s], [-s, 0.0, c]])


# -- three parallel axes ----------------------------------------------------------------------------------------


def _parallel_axes(chain: JointChain) -> ParallelAxes | None:
    """Return the lengths of a chain if it may have this structure, read off with all angles 0. The structure is
    not proven yet."""
    at, turns = np.cumsum(np.array(chain.origins_mm), axis=0), _directions(chain)
    numbers = chain.axis_numbers
    if (
        len({*numbers[1:4]}) != 1
        or numbers[0] == numbers[1]
        or numbers[3] == numbers[4]
        or numbers[4] == numbers[5]
    ):
        return None
    up, across, fifth, sixth = turns[0], turns[1], turns[4], turns[5]
    x1, y1, x4 = np.cross(-across, up), up, np.cross(across, fifth)
    crossings_off_mm = (
        (at[1] - at[0]) @ np.cross(up, across),
        (at[4] - at[3]) @ np.cross(across, fifth),
        (at[5] - at[4]) @ np.cross(fifth, sixth),
    )
    if np.abs(crossings_off_mm).max() > _MEETS_MM:
        return None
    upper, fore = at[2] - at[1], at[3] - at[2]
    first_mm = at[0] + ((at[1] - at[0]) @ up) * up
    fourth_mm = at[3] + ((at[4] - at[3]) @ across) * across
    last_mm = at[4] + ((at[5] - at[4]) @ fifth) * fifth
    upper_rad, fore_rad = (np.arctan2(v @ y1, v @ x1) for v in (upper, fore))
    wrist_rad, fifth_rad = np.arctan2(fifth @ x1, -fifth @ y1), np.arctan2(-sixth @ x4, sixth @ across)
    base_from_first, base_from_last, base_from_flange = np.eye(4), np.eye(4), np.eye(4)
    base_from_first[:3] = np.column_stack([x1, -across, up, first_mm])
    x6 = np.cos(fifth_rad) * x4 + np.sin(fifth_rad) * across
    base_from_last[:3] = np.column_stack([x6, np.cross(sixth, x6), sixth, last_mm])
    base_from_flange[:3, 3] = at[5]
    zeros = (0.0, upper_rad, fore_rad - upper_rad, wrist_rad - fore_rad, fifth_rad, 0.0)
    return ParallelAxes(
        a2_mm=float(np.hypot(upper @ x1, upper @ y1)),
        a3_mm=float(np.hypot(fore @ x1, fore @ y1)),
        d4_mm=float((fourth_mm - first_mm) @ across),
        d5_mm=float((last_mm - fourth_mm) @ fifth),
        senses=(1.0, 1.0, float(turns[2] @ across), float(turns[3] @ across), 1.0, 1.0),
        zeros_rad=tuple(float(zero) for zero in zeros),
        base_from_first=_rows(base_from_first),
        last_from_flange=_rows(inverse(base_from_last) @ base_from_flange @ np.array(chain.link_6_from_flange)),
    )


def _branches_of_parallel_axes(arm: ParallelAxes, base_from_flange: Transform) -> list[Floats]:
    """Return the branches, by a derivation from the chain. The vector n, along axes 2 to 4, is (sin t1, -cos t1,
    0) in the first frame. The last frame's origin lies d4 along n. In the last frame, n is (sin t5 cos t6, -sin t5
    sin t6, cos t5), and axis 5 is (-sin t6, -cos t6, 0). The rest is a chain of two links in the plane across
    n."""
    last = inverse(np.array(arm.base_from_first)) @ base_from_flange @ inverse(np.array(arm.last_from_flange))
    rotation, place_mm = last[:3, :3], last[:3, 3]
    out_mm = float(np.hypot(place_mm[0], place_mm[1]))
    if out_mm * (1.0 + _ROUNDING) < abs(arm.d4_mm) or out_mm == 0.0:
        return []
    towards, aside = np.arctan2(place_mm[1], place_mm[0]), np.arcsin(np.clip(arm.d4_mm / out_mm, -1.0, 1.0))
    solutions_rad = []
    for t1 in (towards + aside, towards + np.pi - aside):
        across = np.array((np.sin(t1), -np.cos(t1), 0.0))
        axis_in_flange = rotation.T @ across
        sine = float(np.hypot(axis_in_flange[0], axis_in_flange[1]))
        for t5 in (np.arctan2(sine, axis_in_flange[2]), -np.arctan2(sine, axis_in_flange[2])):
            # With the wrist stretched axes 2 to 4 and 6 are parallel: of the family of solutions the one with t6 =
            # 0 is given.
            t6 = (
                np.arctan2(-axis_in_flange[1] * np.sign(t5), axis_in_flange[0] * np.sign(t5))
                if sine > _ROUNDING
                else 0.0
            )
            fifth = rotation @ np.array((-np.sin(t6), -np.cos(t6), 0.0))
            elbow_mm = place_mm - arm.d5_mm * fifth - arm.d4_mm * across
            x_mm, y_mm = elbow_mm[0] * np.cos(t1) + elbow_mm[1] * np.sin(t1), elbow_mm[2]
            bend = (x_mm**2 + y_mm**2 - arm.a2_mm**2 - arm.a3_mm**2) / (2.0 * arm.a2_mm * arm.a3_mm)
            if abs(bend) > 1.0 + _ROUNDING:
                continue
            wrist = np.arctan2(fifth[0] * np.cos(t1) + fifth[1] * np.sin(t1), -fifth[2])
            for t3 in (np.arccos(np.clip(bend, -1.0, 1.0)), -np.arccos(np.clip(bend, -1.0, 1.0))):
                t2 = np.arctan2(y_mm, x_mm) - np.arctan2(
                    arm.a3_mm * np.sin(t3), arm.a2_mm + arm.a3_mm * np.cos(t3)
                )
                solutions_rad.append(
                    (np.array((t1, t2, t3, wrist - t2 - t3, t5, t6)) - arm.zeros_rad) * arm.senses
                )
    return [np.degrees((angles + np.pi) % (2.0 * np.pi) - np.pi) + 0.0 for angles in solutions_rad]


def _rows(matrix: Transform) -> tuple[tuple[float, ...], ...]:
    """Return the rows, rounded if only rounding errors keep the entries of a rotation from ones and zeros."""
    return tuple(tuple(row) for row in matrix.round(13).tolist())

"""The arm: where its flange is, which joint angles bring it to a pose, and how long a motion takes.

Joint angles are KUKA's A1 to A6 in degrees, poses are `base_from_flange` (4x4, mm; base is $ROBROOT).
Forward kinematics is written out here; inverse kinematics is py-opw-kinematics', which has traps that this
module takes away: it wraps angles to +-180 though axes turn further, and finds nothing where A5 is exactly 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.geometry import Transform

Six = tuple[float, ...]

_LIMIT_TOLERANCE_DEG = 1e-9
_WRIST_NUDGE_RAD = 1e-3


@dataclass(frozen=True)
class Arm:
    """An arm with ortho-parallel basis and spherical wrist (OPW).

    Geometry as in Brandstoetter, Angerer, Hofbaur: "An Analytical Solution of the Inverse Kinematics Problem
    of Industrial Serial Manipulators with an Ortho-parallel Basis and a Spherical Wrist" (2014), fig. 2.
    """

    name: str
    a1_mm: float
    a2_mm: float
    b_mm: float
    c1_mm: float
    c2_mm: float
    c3_mm: float
    c4_mm: float
    offsets_deg: Six
    flip_axes: tuple[bool, ...]
    """True where the axis turns against OPW's sense."""
    limits_deg: tuple[tuple[float, float], ...]
    """Lowest and highest angle of each axis."""
    velocity_deg_s: Six
    acceleration_deg_s2: Six
    jerk_deg_s3: Six


KR10_R1100_SIXX = Arm(
    name="KR10 R1100 sixx",
    a1_mm=25.0,
    a2_mm=-35.0,
    b_mm=0.0,
    c1_mm=400.0,
    c2_mm=560.0,
    c3_mm=515.0,
    c4_mm=80.0,
    offsets_deg=(0.0, -90.0, 0.0, 0.0, 0.0, 0.0),
    flip_axes=(True, False, False, True, False, True),
    limits_deg=((-170, 170), (-190, 45), (-120, 156), (-185, 185), (-120, 120), (-350, 350)),
    velocity_deg_s=(300, 225, 225, 381, 311, 492),
    acceleration_deg_s2=(300, 300, 300, 300, 300, 300),
    jerk_deg_s3=(3000, 3000, 3000, 3000, 3000, 3000),
)
"""Limits and speeds from the data sheet; KUKA publishes no accelerations, these are cautious ones."""


def slowed(arm: Arm, *, speed_fraction: float, acceleration_deg_s2: float, jerk_deg_s3: float) -> Arm:
    """The same arm, moved at a fraction of its speeds and with one acceleration and jerk for all axes."""
    return replace(
        arm,
        velocity_deg_s=tuple(v * speed_fraction for v in arm.velocity_deg_s),
        acceleration_deg_s2=(acceleration_deg_s2,) * 6,
        jerk_deg_s3=(jerk_deg_s3,) * 6,
    )


def forward(arm: Arm, joints_deg: ArrayLike) -> Transform:
    """`base_from_flange` [..., 4, 4] of joint angles [..., 6] (Brandstoetter 2014, eq. 1 to 5)."""
    joints = np.asarray(joints_deg, dtype=np.float64)
    theta = np.radians(np.where(arm.flip_axes, -joints, joints) - np.asarray(arm.offsets_deg))
    s1, s2, _, s4, s5, s6 = np.moveaxis(np.sin(theta), -1, 0)
    c1, c2, _, c4, c5, c6 = np.moveaxis(np.cos(theta), -1, 0)
    s23, c23 = np.sin(theta[..., 1] + theta[..., 2]), np.cos(theta[..., 1] + theta[..., 2])

    # the wrist centre in the plane of the arm, then turned about axis 1
    out_mm = arm.c2_mm * s2 + arm.c3_mm * s23 + arm.a2_mm * c23 + arm.a1_mm
    up_mm = arm.c2_mm * c2 + arm.c3_mm * c23 - arm.a2_mm * s23 + arm.c1_mm

    zero = np.zeros_like(s1)
    base_from_elbow = _stack(
        ((c1 * c23, -s1, c1 * s23), (s1 * c23, c1, s1 * s23), (-s23, zero, c23)),
    )
    elbow_from_flange = _stack(
        (
            (c4 * c5 * c6 - s4 * s6, -c4 * c5 * s6 - s4 * c6, c4 * s5),
            (s4 * c5 * c6 + c4 * s6, -s4 * c5 * s6 + c4 * c6, s4 * s5),
            (-s5 * c6, s5 * s6, c5),
        ),
    )
    base_from_flange = np.zeros((*joints.shape[:-1], 4, 4))
    rotation = base_from_elbow @ elbow_from_flange
    wrist_mm = np.stack((out_mm * c1 - arm.b_mm * s1, out_mm * s1 + arm.b_mm * c1, up_mm), axis=-1)
    base_from_flange[..., :3, :3] = rotation
    base_from_flange[..., :3, 3] = wrist_mm + arm.c4_mm * rotation[..., :, 2]
    base_from_flange[..., 3, 3] = 1.0
    return base_from_flange


JOINT_AXES = (2, 1, 1, 0, 1, 0)
"""About which axis of its link's frame (0 x, 1 y, 2 z) each joint turns."""


def joint_origins_mm(arm: Arm) -> tuple[tuple[float, float, float], ...]:
    """Where each joint lies in the frame of the link before it."""
    return (
        (0.0, arm.b_mm, arm.c1_mm),
        (arm.a1_mm, 0.0, 0.0),
        (arm.c2_mm, 0.0, 0.0),
        (0.0, 0.0, -arm.a2_mm),
        (arm.c3_mm, 0.0, 0.0),
        (arm.c4_mm, 0.0, 0.0),
    )


def axis_senses(arm: Arm) -> Six:
    """1 for each axis that turns right-handed about its JOINT_AXES, -1 for the others."""
    return tuple(-1.0 if flipped else 1.0 for flipped in arm.flip_axes)


def link_frames(arm: Arm, joints_deg: ArrayLike) -> NDArray[np.float64]:
    """`base_from_link` [..., 8, 4, 4] of joint angles [..., 6]: base, the six links, the flange.

    A link's frame lies in its joint and, with all angles 0 (the arm stretched out along x), parallel to the base;
    the flange's is that of `forward`. These are the frames of the vendor's link meshes (facts/robot.md).
    """
    joints = np.radians(np.array(axis_senses(arm)) * np.asarray(joints_deg, dtype=np.float64))
    frames = np.zeros((*joints.shape[:-1], 8, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    for k, (origin_mm, axis) in enumerate(zip(joint_origins_mm(arm), JOINT_AXES, strict=True)):
        step = np.zeros((*joints.shape[:-1], 4, 4))
        c, s = np.cos(joints[..., k]), np.sin(joints[..., k])
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step[..., range(4), range(4)] = 1.0
        step[..., i, i], step[..., j, j], step[..., i, j], step[..., j, i] = c, c, -s, s
        step[..., :3, 3] = origin_mm
        frames[..., k + 1, :, :] = frames[..., k, :, :] @ step
    link_from_flange = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    frames[..., 7, :, :] = frames[..., 6, :, :] @ link_from_flange
    return frames


def inverse(arm: Arm, base_from_flange: Transform) -> NDArray[np.float64]:
    """All joint angles [k, 6] within the limits that reach the pose; k is 0 where there are none.

    Every turn of an axis that its limits allow counts as a solution of its own. Where A5 is 0 the sum of A4
    and A6 alone matters: of that family the member with A4 = 0 is given.
    """
    solutions = [
        turned
        for branch in _branches(arm, base_from_flange)
        for turned in product(*(_turns(a, limits) for a, limits in zip(branch, arm.limits_deg, strict=True)))
    ]
    return np.unique(np.array(solutions, dtype=np.float64).reshape(-1, 6).round(12) + 0.0, axis=0)


def nearest(arm: Arm, solutions_deg: ArrayLike, from_joints_deg: ArrayLike) -> NDArray[np.float64]:
    """The solution [6] that is reached first at the joint speed limits; of equals (1 ms), the one that stays
    farthest from its limits.

    Raises ValueError where there is none to choose from: ask `unreachable_reason` before.
    """
    solutions = np.asarray(solutions_deg, dtype=np.float64).reshape(-1, 6)
    if len(solutions) == 0:
        raise ValueError("no solution to choose from")
    travel_s = np.max(np.abs(solutions - np.asarray(from_joints_deg)) / np.array(arm.velocity_deg_s), axis=1)
    order = np.lexsort((-limit_margin_deg(arm, solutions), np.round(travel_s, 3)))
    best: NDArray[np.float64] = solutions[order[0]]
    return best


def limit_margin_deg(arm: Arm, joints_deg: ArrayLike) -> NDArray[np.float64]:
    """Degrees [...] between joint angles [..., 6] and the nearest limit; negative outside."""
    joints = np.asarray(joints_deg, dtype=np.float64)
    low, high = np.array(arm.limits_deg).T
    margin: NDArray[np.float64] = np.minimum(joints - low, high - joints).min(axis=-1)
    return margin


def within_limits(arm: Arm, joints_deg: ArrayLike) -> bool:
    """True if all joint angles [..., 6] are finite and within their limits (1e-9 deg of rounding allowed)."""
    return bool(np.all(limit_margin_deg(arm, joints_deg) >= -_LIMIT_TOLERANCE_DEG))


def limit_violations(arm: Arm, joints_deg: ArrayLike) -> str:
    """Which axes of [6] are out of their limits, as a phrase for messages; empty if none is."""
    phrases = [
        f"A{axis} would be {angle:.3f} deg, its limits are {low:g} to {high:g} deg"
        for axis, (angle, (low, high)) in enumerate(
            zip(np.asarray(joints_deg, dtype=np.float64), arm.limits_deg, strict=True), start=1
        )
        if not low - _LIMIT_TOLERANCE_DEG <= angle <= high + _LIMIT_TOLERANCE_DEG
    ]
    return "; ".join(phrases)


def unreachable_reason(arm: Arm, base_from_flange: Transform) -> str:
    """Why `inverse` finds nothing, as a phrase for messages; empty if it finds something.

    Of the ways to reach the pose with axes out of their limits, the one that needs least more is told.
    """
    branches = _branches(arm, base_from_flange)
    if not branches:
        radius_mm = np.linalg.norm(base_from_flange[:3, 3] - (0.0, 0.0, arm.c1_mm))
        return f"out of reach: the flange would be {radius_mm:.0f} mm from the shoulder"
    if len(inverse(arm, base_from_flange)):
        return ""
    closest = [
        min((_outside_deg(a + turn, limits), a + turn) for turn in (0.0, 360.0, -360.0))
        for branch in branches
        for a, limits in zip(branch, arm.limits_deg, strict=True)
    ]
    per_branch = [closest[i : i + 6] for i in range(0, len(closest), 6)]
    best = min(per_branch, key=lambda axes: max(outside for outside, _ in axes))
    return limit_violations(arm, [angle for _, angle in best])


def move_duration_s(arm: Arm, from_joints_deg: ArrayLike, to_joints_deg: ArrayLike) -> float:
    """`move_durations_s` of one motion."""
    return float(move_durations_s(arm, from_joints_deg, to_joints_deg))


def move_durations_s(arm: Arm, from_joints_deg: ArrayLike, to_joints_deg: ArrayLike) -> NDArray[np.float64]:
    """Durations [...] of jerk-limited motions from rest to rest on straight lines in joint space [..., 6], as fast
    as the axes that limit them allow: the profile that the driver runs.

    The profile is symmetric: speed is gained for `ramp_s`, kept, and lost as it was gained. A distance d at the
    highest speed v then takes d / v + ramp_s(v), with ramp_s(v) = v / a + a / j where the acceleration a is
    reached and 2 sqrt(v / j) where it is not (Biagiotti, Melchiorri, "Trajectory Planning for Automatic Machines
    and Robots", 2008, sec. 3.4). Distances count in whole motions: d is 1.
    """
    way_deg = np.abs(np.asarray(to_joints_deg, dtype=np.float64) - np.asarray(from_joints_deg))
    share_of_deg = 1.0 / np.maximum(way_deg, 1e-9)
    v_most, a_most, j_most = (
        np.min(np.array(limits) * share_of_deg, axis=-1)
        for limits in (arm.velocity_deg_s, arm.acceleration_deg_s2, arm.jerk_deg_s3)
    )
    ramp_of_jerk_s = a_most / j_most
    v_reached = np.where(
        j_most**2 >= 2.0 * a_most**3,
        (np.sqrt(ramp_of_jerk_s**2 + 4.0 / a_most) - ramp_of_jerk_s) * a_most / 2.0,
        np.cbrt(j_most / 4.0),
    )
    v = np.minimum(v_most, v_reached)
    ramp_s = np.where(v >= a_most * ramp_of_jerk_s, v / a_most + ramp_of_jerk_s, 2.0 * np.sqrt(v / j_most))
    durations_s: NDArray[np.float64] = np.where(way_deg.max(axis=-1) > 0.0, 1.0 / v + ramp_s, 0.0)
    return durations_s


def _stack(rows: tuple[tuple[Any, ...], ...]) -> NDArray[np.float64]:
    """[..., 3, 3] of entries [...]."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _turns(angle_deg: float, limits: tuple[float, float]) -> list[float]:
    """The same angle in all turns that the limits allow."""
    return [
        angle_deg + turn
        for turn in (-360.0, 0.0, 360.0)
        if _outside_deg(angle_deg + turn, limits) <= _LIMIT_TOLERANCE_DEG
    ]


def _outside_deg(angle_deg: float, limits: tuple[float, float]) -> float:
    return max(0.0, limits[0] - angle_deg, angle_deg - limits[1])


@lru_cache(maxsize=8)
def _solver(arm: Arm) -> Any:
    import py_opw_kinematics as opw

    new_model: Any = opw.KinematicModel  # its stub asks for tuples of six, which Arm's fields are
    model = new_model(
        a1=arm.a1_mm,
        a2=arm.a2_mm,
        b=arm.b_mm,
        c1=arm.c1_mm,
        c2=arm.c2_mm,
        c3=arm.c3_mm,
        c4=arm.c4_mm,
        offsets=arm.offsets_deg,
        flip_axes=arm.flip_axes,
    )
    return opw.Robot(model, degrees=True)


def _raw_branches(arm: Arm, base_from_flange: Transform) -> NDArray[np.float64]:
    """[8, 6] in degrees, wrapped to +-180, limits not looked at; NaN where a branch does not exist."""
    from py_opw_kinematics import RigidTransform

    branches: NDArray[np.float64] = _solver(arm).reach(RigidTransform.from_matrix(base_from_flange)).joints[0]
    return branches + 0.0  # makes -0 to 0


def _branches(arm: Arm, base_from_flange: Transform) -> list[NDArray[np.float64]]:
    """The branches [6] that exist, with those added that py-opw-kinematics loses where A5 is exactly 0."""
    raw = _raw_branches(arm, base_from_flange)
    found = [branch for branch in raw if not np.isnan(branch).any()]
    if len(found) == len(raw):
        return found
    # Turned a little about the wrist centre the same wrist position is reached by the same A1, A2, A3.
    nudged = np.array(base_from_flange, dtype=np.float64)
    wrist_mm = nudged[:3, 3] - arm.c4_mm * nudged[:3, 2]
    c, s = np.cos(_WRIST_NUDGE_RAD), np.sin(_WRIST_NUDGE_RAD)
    nudged[:3, :3] = nudged[:3, :3] @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    nudged[:3, 3] = wrist_mm + arm.c4_mm * nudged[:3, 2]
    for branch in _raw_branches(arm, nudged):
        straight = np.array([*branch[:3], 0.0, 0.0, 0.0])
        turn = forward(arm, straight)[:3, :3].T @ base_from_flange[:3, :3]
        if not turn[2, 2] >= 1.0 - 1e-12:  # also where the branch is NaN
            continue
        a6_deg = np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))
        found.append(np.array([*straight[:5], -a6_deg if arm.flip_axes[5] else a6_deg]))
    return found

"""Kinematics of the arm: forward, inverse, and durations of motions.

Joint angles are A1 to A6 in degrees, poses are `base_from_flange` (4x4, mm; a KUKA's base is $ROBROOT). The arm is
data: `Arm` holds a description's values (`coupole.plan.arm_description` reads them).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole import joint_chain
from coupole.geometry import Transform
from coupole.joint_chain import FLANGE, JointChain, ParallelAxes, SphericalWrist

__all__ = [
    "Arm",
    "JointChain",
    "ParallelAxes",
    "SphericalWrist",
    "forward",
    "inverse",
    "limit_margin_deg",
    "limit_violations",
    "link_frames",
    "move_duration_s",
    "move_durations_s",
    "nearest",
    "slowed_arm",
    "structure_of",
    "unreachable_reason",
    "within_limits",
]

Six = tuple[float, ...]

_LIMIT_TOLERANCE_DEG = 1e-9


@dataclass(frozen=True)
class Arm:
    """An arm with six revolute joints, with their limits and speeds."""

    name: str
    chain: JointChain
    limits_deg: tuple[tuple[float, float], ...]
    """Lowest and highest angle of each axis."""
    velocity_deg_s: Six
    acceleration_deg_s2: Six
    jerk_deg_s3: Six


def slowed_arm(arm: Arm, *, speed_fraction: float, acceleration_deg_s2: float, jerk_deg_s3: float) -> Arm:
    """Return the same arm with a fraction of its speeds, and with one acceleration and jerk for all axes."""
    return replace(
        arm,
        velocity_deg_s=tuple(v * speed_fraction for v in arm.velocity_deg_s),
        acceleration_deg_s2=(acceleration_deg_s2,) * 6,
        jerk_deg_s3=(jerk_deg_s3,) * 6,
    )


def forward(arm: Arm, joints_deg: ArrayLike) -> Transform:
    """Return `base_from_flange` [..., 4, 4] for joint angles [..., 6]."""
    pose: Transform = joint_chain.link_frames(arm.chain, joints_deg)[..., FLANGE, :, :]
    return pose


def link_frames(arm: Arm, joints_deg: ArrayLike) -> NDArray[np.float64]:
    """Return `base_from_link` [..., 8, 4, 4] for joint angles [..., 6]: base, the six links, the flange.

    A link's frame has its origin in its joint and, with all angles 0, is parallel to the base frame. The flange's
    frame is that of `forward`.
    """
    return joint_chain.link_frames(arm.chain, joints_deg)


def structure_of(arm: Arm) -> SphericalWrist | ParallelAxes | None:
    """The arm's structure for `inverse`; None if `inverse` cannot solve it."""
    return joint_chain.structure_of(arm.chain)


def inverse(arm: Arm, base_from_flange: Transform) -> NDArray[np.float64]:
    """Return all joint angles [k, 6] within the limits that reach the pose; k is 0 if there are none.

    Full turns of an axis within its limits count as separate solutions. With the wrist stretched, two axes are
    parallel, and there is a family of solutions. One of them is given: with A4 = 0 for a spherical wrist, with A6
    = 0 for an arm with three parallel axes. Raises ValueError for an arm without `structure_of`.
    """
    solutions = [
        angles_deg
        for branch in joint_chain.branches(arm.chain, base_from_flange)
        for angles_deg in product(*(_turns(a, limits) for a, limits in zip(branch, arm.limits_deg, strict=True)))
    ]
    return np.unique(np.array(solutions, dtype=np.float64).reshape(-1, 6).round(12) + 0.0, axis=0)


def nearest(arm: Arm, solutions_deg: ArrayLike, from_joints_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the solution [6] that is reached first at the joint speed limits. If several are equally fast (within
    1 ms), it is the one farthest from its limits.

        Raises ValueError if there is no solution: check with `unreachable_reason` first.
    """
    solutions = np.asarray(solutions_deg, dtype=np.float64).reshape(-1, 6)
    if len(solutions) == 0:
        raise ValueError("no solution to choose from")
    travel_s = np.max(np.abs(solutions - np.asarray(from_joints_deg)) / np.array(arm.velocity_deg_s), axis=1)
    order = np.lexsort((-limit_margin_deg(arm, solutions), np.round(travel_s, 3)))
    best: NDArray[np.float64] = solutions[order[0]]
    return best


def limit_margin_deg(arm: Arm, joints_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the degrees [...] between joint angles [..., 6] and the nearest limit; negative outside."""
    joints = np.asarray(joints_deg, dtype=np.float64)
    low, high = np.array(arm.limits_deg).T
    margin: NDArray[np.float64] = np.minimum(joints - low, high - joints).min(axis=-1)
    return margin


def within_limits(arm: Arm, joints_deg: ArrayLike) -> bool:
    """True if all joint angles [..., 6] are finite and within their limits (1e-9 deg of rounding allowed)."""
    return bool(np.all(limit_margin_deg(arm, joints_deg) >= -_LIMIT_TOLERANCE_DEG))


def limit_violations(arm: Arm, joints_deg: ArrayLike) -> str:
    """Return the axes of [6] that are out of their limits, as a phrase for messages; empty if there are none."""
    phrases = [
        f"A{axis} would be {angle:.3f} deg, its limits are {low:g} to {high:g} deg"
        for axis, (angle, (low, high)) in enumerate(
            zip(np.asarray(joints_deg, dtype=np.float64), arm.limits_deg, strict=True), start=1
        )
        if not low - _LIMIT_TOLERANCE_DEG <= angle <= high + _LIMIT_TOLERANCE_DEG
    ]
    return "; ".join(phrases)


def unreachable_reason(arm: Arm, base_from_flange: Transform) -> str:
    """Return why `inverse` finds nothing, as a phrase for messages; empty if it finds something.

    Among solutions with axes out of their limits, the one with the least excess is reported.
    """
    branches = joint_chain.branches(arm.chain, base_from_flange)
    if not branches:
        radius_mm = np.linalg.norm(base_from_flange[:3, 3] - joint_chain.shoulder_mm(arm.chain))
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
    """Return the `move_durations_s` of one motion."""
    return float(move_durations_s(arm, from_joints_deg, to_joints_deg))


def move_durations_s(arm: Arm, from_joints_deg: ArrayLike, to_joints_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the durations [...] of jerk-limited motions from rest to rest on straight lines in joint space [...,
    6]. The motions are as fast as the slowest axis allows, with the profile that the driver uses.

    The profile is symmetric: speed is gained for `ramp_s`, kept, and lost as it was gained. A distance d at the
    highest speed v then takes d / v + ramp_s(v). Here ramp_s(v) is v / a + a / j if the acceleration a is reached,
    and 2 sqrt(v / j) otherwise (Biagiotti, Melchiorri, "Trajectory Planning for Automatic Machines and Robots",
    2008, sec. 3.4). Distances are measured in units of the whole motion, so d is 1.
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


def _turns(angle_deg: float, limits: tuple[float, float]) -> list[float]:
    """Return the same angle in all turns that the limits allow."""
    return [
        angle_deg + turn
        for turn in (-360.0, 0.0, 360.0)
        if _outside_deg(angle_deg + turn, limits) <= _LIMIT_TOLERANCE_DEG
    ]


def _outside_deg(angle_deg: float, limits: tuple[float, float]) -> float:
    return max(0.0, limits[0] - angle_deg, angle_deg - limits[1])

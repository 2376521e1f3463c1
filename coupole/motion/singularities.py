"""Singularities of the arm, where small motions of the camera need large motions of an axis, and the distances of
postures from them.

An arm with a spherical wrist has three singularities (Siciliano et al., "Robotics", 2009, sec. 3.3). The wrist is
stretched, so that axes 4 and 6 turn about one line. The elbow is stretched or folded, so that the arm cannot reach
farther or nearer. Or the wrist's centre is on axis 1, so that the angle of axis 1 is undetermined. An arm with
three parallel axes also has three singularities: axis 6 is parallel to them; the elbow is stretched or folded; or
the intersection of axes 5 and 6 is in the plane of axes 1 and 2. Motions are straight in joint space and may cross
singularities. Views avoid singularities, because pose corrections and poses computed from the joints are
ill-conditioned there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.joint_chain import SphericalWrist
from coupole.kinematics import Arm, limit_margin_deg, structure_of


@dataclass(frozen=True)
class SingularityMargin:
    """Least distances of a view's posture from singularities."""

    wrist_deg: float = 5.0
    """Least angle of A5 from the stretched wrist."""
    elbow_deg: float = 5.0
    """Least difference of the angle between upper arm and forearm from the stretched and from the folded elbow."""
    shoulder_mm: float = 20.0
    """Least distance of the wrist's centre from axis 1, or from the plane of axes 1 and 2."""


SINGULARITY_MARGIN = SingularityMargin()
_FREE_MARGIN = 3.0
"""Singularity margin above which the posture cost is zero."""
_FREE_LIMIT_MARGIN_DEG = 10.0


def distances(arm: Arm, joints_deg: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    """Return the distances [...] of joint angles [..., 6] from the singularities of wrist (deg), elbow (deg) and
    shoulder (mm). Raises ValueError for an arm without `structure_of`."""
    structure = structure_of(arm)
    if structure is None:
        raise ValueError(f"the singularities of {arm.name} are not known: its chain has no closed solution")
    theta = structure.theta(joints_deg)
    _, t2, t3, t4, t5, _ = np.moveaxis(theta, -1, 0)
    if isinstance(structure, SphericalWrist):
        lengths = structure.lengths
        bend, fore = t3 + np.arctan2(lengths.a2_mm, lengths.c3_mm), t2 + t3
        out_mm = (
            lengths.c2_mm * np.sin(t2)
            + lengths.c3_mm * np.sin(fore)
            + lengths.a2_mm * np.cos(fore)
            + lengths.a1_mm
        )
        shoulder_mm = np.hypot(out_mm, lengths.b_mm)
    else:
        bend = t3
        out_mm = (
            structure.a2_mm * np.cos(t2)
            + structure.a3_mm * np.cos(t2 + t3)
            + structure.d5_mm * np.sin(t2 + t3 + t4)
        )
        shoulder_mm = np.abs(out_mm)
    return _from_half_turn_deg(t5), _from_half_turn_deg(bend), shoulder_mm


def _from_half_turn_deg(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of an angle in radians from the nearest multiple of pi, in degrees."""
    off: NDArray[np.float64] = np.abs((np.degrees(angle) + 90.0) % 180.0 - 90.0)
    return off


def margin(
    arm: Arm, joints_deg: ArrayLike, required_margin: SingularityMargin = SINGULARITY_MARGIN
) -> NDArray[np.float64]:
    """Return [...] the distance of a posture [..., 6] from the nearest singularity, over the least distance
    allowed."""
    wrist_deg, elbow_deg, shoulder_mm = distances(arm, joints_deg)
    shares = (
        wrist_deg / required_margin.wrist_deg,
        elbow_deg / required_margin.elbow_deg,
        shoulder_mm / required_margin.shoulder_mm,
    )
    least: NDArray[np.float64] = np.minimum.reduce(shares)
    return least


def reason(arm: Arm, joints_deg: ArrayLike, required_margin: SingularityMargin = SINGULARITY_MARGIN) -> str:
    """Return the singularity that is too near to a posture [6], as a phrase for messages; empty if there is
    none."""
    wrist_deg, elbow_deg, shoulder_mm = (float(distance) for distance in distances(arm, joints_deg))
    if wrist_deg < required_margin.wrist_deg:
        return (
            f"the wrist would be stretched, with A5 {wrist_deg:.1f} deg from its singularity; "
            f"{required_margin.wrist_deg:g} deg must be kept"
        )
    if elbow_deg < required_margin.elbow_deg:
        return (
            f"the elbow would be stretched or folded, with A3 {elbow_deg:.1f} deg from its singularity; "
            f"{required_margin.elbow_deg:g} deg must be kept"
        )
    if shoulder_mm < required_margin.shoulder_mm:
        where = "axis 1" if isinstance(structure_of(arm), SphericalWrist) else "the plane of axes 1 and 2"
        return (
            f"the wrist's centre would be {shoulder_mm:.1f} mm from {where}, the shoulder's singularity; "
            f"{required_margin.shoulder_mm:g} mm must be kept"
        )
    return ""


def posture_cost(arm: Arm, postures_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [k]: 0 for postures [k, 6] far from singularities and limits, up to 1 for postures that are only just
    allowed."""
    from_singular = (_FREE_MARGIN - margin(arm, postures_deg)) / (_FREE_MARGIN - 1.0)
    from_limit = 1.0 - limit_margin_deg(arm, postures_deg) / _FREE_LIMIT_MARGIN_DEG
    cost: NDArray[np.float64] = np.clip(np.maximum(from_singular, from_limit), 0.0, 1.0)
    return cost

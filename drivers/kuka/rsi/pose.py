"""The flange's pose in plain Python. The computation is fast enough for every cycle, in a process that does not
import numpy.

Millimetres and degrees, in the base frame. A correction of the pose is six numbers X, Y, Z, A, B, C. The
translation is added in base coordinates. The rotation Rz(A) Ry(B) Rx(C) is applied from the left, in base axes:

    position = position before + (X, Y, Z)        rotation = Rz(A) Ry(B) Rx(C) * rotation before
"""

from __future__ import annotations

from math import atan2, cos, degrees, hypot, radians, sin
from typing import NamedTuple

from coupole.wrist_lengths import WristLengths

Six = tuple[float, ...]
Rotation = tuple[float, ...]
"""Row by row, nine numbers."""

_GIMBAL_LOCK = 1e-9


class Pose(NamedTuple):
    """`base_from_flange`."""

    position_mm: tuple[float, float, float]
    rotation: Rotation


def flange_pose(arm: WristLengths, joints_deg: Six) -> Pose:
    """Pose at joint angles [6]; Brandstoetter 2014, eq. 1 to 5 (`SphericalWrist`)."""
    t1, t2, t3, t4, t5, t6 = (
        radians((-angle if flip else angle) - offset)
        for angle, flip, offset in zip(joints_deg, arm.flip_axes, arm.offsets_deg, strict=True)
    )
    s1, c1, s23, c23 = sin(t1), cos(t1), sin(t2 + t3), cos(t2 + t3)
    s4, c4, s5, c5, s6, c6 = sin(t4), cos(t4), sin(t5), cos(t5), sin(t6), cos(t6)
    out_mm = arm.c2_mm * sin(t2) + arm.c3_mm * s23 + arm.a2_mm * c23 + arm.a1_mm
    up_mm = arm.c2_mm * cos(t2) + arm.c3_mm * c23 - arm.a2_mm * s23 + arm.c1_mm
    base_from_elbow = (c1 * c23, -s1, c1 * s23, s1 * c23, c1, s1 * s23, -s23, 0.0, c23)
    elbow_from_flange = (
        *(c4 * c5 * c6 - s4 * s6, -c4 * c5 * s6 - s4 * c6, c4 * s5),
        *(s4 * c5 * c6 + c4 * s6, -s4 * c5 * s6 + c4 * c6, s4 * s5),
        *(-s5 * c6, s5 * s6, c5),
    )
    rotation = _product(base_from_elbow, elbow_from_flange)
    position_mm = (
        out_mm * c1 - arm.b_mm * s1 + arm.c4_mm * rotation[2],
        out_mm * s1 + arm.b_mm * c1 + arm.c4_mm * rotation[5],
        up_mm + arm.c4_mm * rotation[8],
    )
    return Pose(position_mm, rotation)


def correction(before: Pose, after: Pose) -> Six:
    """Return X, Y, Z in mm and A, B, C in degrees that lead from `before` to `after`. If B is +-90, C is 0."""
    r = _product(after.rotation, _transpose(before.rotation))
    cos_b = hypot(r[0], r[3])
    b = atan2(-r[6], cos_b)
    a, c = (atan2(r[3], r[0]), atan2(r[7], r[8])) if cos_b > _GIMBAL_LOCK else (atan2(-r[1], r[4]), 0.0)
    (x0, y0, z0), (x1, y1, z1) = before.position_mm, after.position_mm
    return x1 - x0, y1 - y0, z1 - z0, degrees(a), degrees(b), degrees(c)


def corrected_pose(before: Pose, values: Six) -> Pose:
    """The pose after a correction of X, Y, Z in mm and A, B, C in degrees."""
    x, y, z, a_deg, b_deg, c_deg = values
    x0, y0, z0 = before.position_mm
    a, b, c = radians(a_deg), radians(b_deg), radians(c_deg)
    ca, sa, cb, sb, cc, sc = cos(a), sin(a), cos(b), sin(b), cos(c), sin(c)
    turn = (
        *(ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc),
        *(sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc),
        *(-sb, cb * sc, cb * cc),
    )
    return Pose((x0 + x, y0 + y, z0 + z), _product(turn, before.rotation))


def _product(a: Rotation, b: Rotation) -> Rotation:
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    return (
        *(a0 * b0 + a1 * b3 + a2 * b6, a0 * b1 + a1 * b4 + a2 * b7, a0 * b2 + a1 * b5 + a2 * b8),
        *(a3 * b0 + a4 * b3 + a5 * b6, a3 * b1 + a4 * b4 + a5 * b7, a3 * b2 + a4 * b5 + a5 * b8),
        *(a6 * b0 + a7 * b3 + a8 * b6, a6 * b1 + a7 * b4 + a8 * b7, a6 * b2 + a7 * b5 + a8 * b8),
    )


def _transpose(r: Rotation) -> Rotation:
    return r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]

"""The stand-in's UR10e: where its flange is, and how it moves along a straight line in joint space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform

Six = tuple[float, ...]

_DH = (
    (0.0, 180.7, math.pi / 2),
    (-612.7, 0.0, 0.0),
    (-571.55, 0.0, 0.0),
    (0.0, 174.15, math.pi / 2),
    (0.0, 119.85, -math.pi / 2),
    (0.0, 116.55, 0.0),
)
"""Of each joint a and d in mm and alpha in rad, after Denavit and Hartenberg. Source: Universal Robots, "DH
Parameters for calculations of kinematics and dynamics", UR10e."""


def flange_pose(joints_deg: Sequence[float]) -> Transform:
    """`base_from_flange` of six joint angles."""
    base_from_link = np.eye(4)
    for angle_deg, (a, d, alpha) in zip(joints_deg, _DH, strict=True):
        s, c = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
        sa, ca = math.sin(alpha), math.cos(alpha)
        base_from_link = base_from_link @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
    return base_from_link


def rotation_vector(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
    """Axis times angle (rad) of a 3x3 rotation, as UR writes orientations."""
    from_skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = float(np.linalg.norm(from_skew)) / 2.0
    angle = math.atan2(sine, (float(np.trace(rotation)) - 1.0) / 2.0)
    if sine > 1e-6:
        vector = from_skew / (2.0 * sine) * angle
    elif angle < 1.0:
        vector = from_skew / 2.0
    else:  # half a turn: the axis is the largest column of (R + 1) / 2
        column = (rotation + np.eye(3))[:, int(np.argmax(np.diag(rotation)))]
        vector = column / np.linalg.norm(column) * angle
    return float(vector[0]), float(vector[1]), float(vector[2])


@dataclass(frozen=True)
class Motion:
    """Constant accelerations along a straight line in joint space.

    In each phase v = v0 + a t and s = s0 + v0 t + a t^2 / 2, s being the way of the leading axis in degrees.
    """

    start_deg: Six
    unit: Six
    """What each axis turns per degree of the leading one."""
    speed_deg_s: float
    """Of the leading axis, at the start."""
    phases: tuple[tuple[float, float], ...]
    """Duration in s and acceleration in deg/s^2, in order."""
    end_deg: Six
    start_ns: int

    def at(self, t_ns: int) -> tuple[Six, Six, bool]:
        """Joint angles, their speeds in deg/s, and whether the motion goes on."""
        left_s = (t_ns - self.start_ns) / 1e9
        way_deg, speed_deg_s = 0.0, self.speed_deg_s
        for duration_s, acceleration in self.phases:
            t_s = min(left_s, duration_s)
            way_deg += speed_deg_s * t_s + acceleration * t_s * t_s / 2.0
            speed_deg_s += acceleration * t_s
            left_s -= t_s
            if left_s <= 0.0:
                joints_deg = tuple(q + u * way_deg for q, u in zip(self.start_deg, self.unit, strict=True))
                return joints_deg, tuple(u * speed_deg_s for u in self.unit), True
        return self.end_deg, (0.0,) * 6, False


def movej(start_deg: Six, end_deg: Six, speed_deg_s: float, acceleration_deg_s2: float, t_ns: int) -> Motion:
    """From rest to rest, all axes in step: a trapezoid of the leading axis's speed, as URScript's movej."""
    way_deg = max(abs(b - a) for a, b in zip(start_deg, end_deg, strict=True))
    if way_deg == 0.0:
        return Motion(start_deg, (0.0,) * 6, 0.0, (), end_deg, t_ns)
    unit = tuple((b - a) / way_deg for a, b in zip(start_deg, end_deg, strict=True))
    top_deg_s = min(speed_deg_s, math.sqrt(acceleration_deg_s2 * way_deg))
    ramp_s = top_deg_s / acceleration_deg_s2
    phases = (
        (ramp_s, acceleration_deg_s2),
        (way_deg / top_deg_s - ramp_s, 0.0),
        (ramp_s, -acceleration_deg_s2),
    )
    return Motion(start_deg, unit, 0.0, phases, end_deg, t_ns)


def brake(start_deg: Six, velocity_deg_s: Six, deceleration_deg_s2: float, t_ns: int) -> Motion:
    """To rest, along the direction of motion, as URScript's stopj."""
    speed_deg_s = max(map(abs, velocity_deg_s))
    if speed_deg_s == 0.0:
        return Motion(start_deg, (0.0,) * 6, 0.0, (), start_deg, t_ns)
    unit = tuple(v / speed_deg_s for v in velocity_deg_s)
    way_deg = speed_deg_s**2 / (2.0 * deceleration_deg_s2)
    end_deg = tuple(q + u * way_deg for q, u in zip(start_deg, unit, strict=True))
    phases = ((speed_deg_s / deceleration_deg_s2, -deceleration_deg_s2),)
    return Motion(start_deg, unit, speed_deg_s, phases, end_deg, t_ns)

"""The UR stand-in's arm: forward and inverse kinematics, and motions straight in joint space or for the tool."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.devices.kuka_kinematics import turn
from sim.devices.newton import joints_near

Six = tuple[float, ...]

UrModel = Literal["ur5e", "ur10e"]
_DH = {
    "ur5e": (
        (0.0, 162.5, math.pi / 2),
        (-425.0, 0.0, 0.0),
        (-392.2, 0.0, 0.0),
        (0.0, 133.3, math.pi / 2),
        (0.0, 99.7, -math.pi / 2),
        (0.0, 99.6, 0.0),
    ),
    "ur10e": (
        (0.0, 180.7, math.pi / 2),
        (-612.7, 0.0, 0.0),
        (-571.55, 0.0, 0.0),
        (0.0, 174.15, math.pi / 2),
        (0.0, 119.85, -math.pi / 2),
        (0.0, 116.55, 0.0),
    ),
}
"""Values a and d in mm and alpha in rad of each joint, by Denavit and Hartenberg. Source: Universal Robots, "DH
Parameters for calculations of kinematics and dynamics"."""


_LINE_STEP_MM, _LINE_STEP_RAD = 5.0, 0.02
"""Distance of the points of a tool line at which joints are computed; between them, joints move linearly."""


def flange_pose(model: UrModel, joints_deg: Sequence[float]) -> Transform:
    """`base_from_flange` of six joint angles."""
    return chain(model, joints_deg)[0]


def chain(
    model: UrModel, joints_deg: Sequence[float]
) -> tuple[Transform, NDArray[np.float64], NDArray[np.float64]]:
    """`base_from_flange`, and in the base frame the joints' origins in mm and their axes, each [6, 3]."""
    base_from_link = np.eye(4)
    origins_mm, axes = np.zeros((6, 3)), np.zeros((6, 3))
    for k, (angle_deg, (a, d, alpha)) in enumerate(zip(joints_deg, _DH[model], strict=True)):
        origins_mm[k], axes[k] = base_from_link[:3, 3], base_from_link[:3, 2]
        s, c = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
        sa, ca = math.sin(alpha), math.cos(alpha)
        base_from_link = base_from_link @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
    return base_from_link, origins_mm, axes


def rotation_vector(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
    """Axis times angle (rad) of a 3x3 rotation, as in UR poses."""
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
    """Motion with piecewise constant acceleration along a polyline in joint space.

    In each phase v = v0 + a t and s = s0 + v0 t + a t^2 / 2, where s is the path length: degrees of the leading
    axis, or metres of the tool.
    """

    places_deg: tuple[Six, ...]
    """Corners of the polyline, at least two, at equal distances along the path."""
    length: float
    """Path length from the first corner to the last."""
    speed: float
    """Initial speed, path length per second."""
    phases: tuple[tuple[float, float], ...]
    """Duration in s and acceleration in path length/s^2, in order."""
    start_ns: int

    def at(self, t_ns: int) -> tuple[Six, Six, bool]:
        """Joint angles, their speeds in deg/s, and False once the motion has ended."""
        left_s = (t_ns - self.start_ns) / 1e9
        distance, speed = 0.0, self.speed
        for duration_s, acceleration in self.phases:
            t_s = min(left_s, duration_s)
            distance += speed * t_s + acceleration * t_s * t_s / 2.0
            speed += acceleration * t_s
            left_s -= t_s
            if left_s <= 0.0:
                return *self._place(distance, speed), True
        return self.places_deg[-1], (0.0,) * 6, False

    def _place(self, path_length: float, speed: float) -> tuple[Six, Six]:
        """Joint angles and their speeds at path length `path_length`."""
        pieces = len(self.places_deg) - 1
        piece = min(int(path_length / self.length * pieces), pieces - 1)
        share = path_length / self.length * pieces - piece
        here_deg, there_deg = self.places_deg[piece : piece + 2]
        steps_deg = [b - a for a, b in zip(here_deg, there_deg, strict=True)]
        joints_deg = tuple(a + share * step for a, step in zip(here_deg, steps_deg, strict=True))
        return joints_deg, tuple(step * pieces / self.length * speed for step in steps_deg)


def movej(start_deg: Six, end_deg: Six, speed_deg_s: float, acceleration_deg_s2: float, t_ns: int) -> Motion:
    """Return a motion from rest to rest with synchronised axes: trapezoidal speed of the leading axis, as
    URScript's movej."""
    turn_deg = max(abs(b - a) for a, b in zip(start_deg, end_deg, strict=True))
    return _trapezoid((start_deg, end_deg), turn_deg, speed_deg_s, acceleration_deg_s2, t_ns)


def movel(
    model: UrModel,
    start_deg: Six,
    base_from_tool: Transform,
    flange_from_tool: Transform,
    speed_m_s: float,
    acceleration_m_s2: float,
    t_ns: int,
) -> Motion | None:
    """Return a motion from rest to rest, as URScript's movel. The tool moves on a straight line, and turns at a
    constant rate about one axis. None if the arm cannot follow. For a pure rotation, radians count as metres."""
    start = flange_pose(model, start_deg) @ flange_from_tool
    line_mm = base_from_tool[:3, 3] - start[:3, 3]
    turned_rad = np.array(rotation_vector(start[:3, :3].T @ base_from_tool[:3, :3]))
    length_mm, angle_rad = float(np.linalg.norm(line_mm)), float(np.linalg.norm(turned_rad))
    pieces = 1 + int(max(length_mm / _LINE_STEP_MM, angle_rad / _LINE_STEP_RAD))
    tool_from_flange = np.linalg.inv(flange_from_tool)
    places_deg = [start_deg]
    for share in np.linspace(0.0, 1.0, pieces + 1)[1:].tolist():
        tool = start.copy()
        tool[:3, 3] += share * line_mm
        if angle_rad > 0.0:
            axis = (turned_rad / angle_rad).tolist()
            tool[:3, :3] = start[:3, :3] @ turn(axis, math.degrees(share * angle_rad))
        place_deg = joints_near(partial(chain, model), tool @ tool_from_flange, places_deg[-1])
        if place_deg is None:
            return None
        places_deg.append(place_deg)
    return _trapezoid(tuple(places_deg), max(length_mm / 1e3, angle_rad), speed_m_s, acceleration_m_s2, t_ns)


def brake(start_deg: Six, velocity_deg_s: Six, deceleration_deg_s2: float, t_ns: int) -> Motion:
    """Return the motion to rest along the present direction in joint space, as URScript's stopj."""
    speed_deg_s = max(map(abs, velocity_deg_s))
    if speed_deg_s == 0.0:
        return Motion((start_deg, start_deg), 0.0, 0.0, (), t_ns)
    turn_deg = speed_deg_s**2 / (2.0 * deceleration_deg_s2)
    end_deg = tuple(q + v / speed_deg_s * turn_deg for q, v in zip(start_deg, velocity_deg_s, strict=True))
    phases = ((speed_deg_s / deceleration_deg_s2, -deceleration_deg_s2),)
    return Motion((start_deg, end_deg), turn_deg, speed_deg_s, phases, t_ns)


def _trapezoid(places_deg: tuple[Six, ...], length: float, speed: float, acceleration: float, t_ns: int) -> Motion:
    """Return a motion from rest to rest along the corners."""
    if length == 0.0:
        return Motion(places_deg, length, 0.0, (), t_ns)
    top = min(speed, math.sqrt(acceleration * length))
    ramp_s = top / acceleration
    phases = ((ramp_s, acceleration), (length / top - ramp_s, 0.0), (ramp_s, -acceleration))
    return Motion(places_deg, length, 0.0, phases, t_ns)

"""Point-to-point motion as a robot controller plans it: synchronised axes, limited acceleration and jerk.

The axes move on a straight line in joint space, along which a path parameter runs from 0 to 1. Its speed,
acceleration and jerk are limited by the most restrictive axis. Written independently of the library that
`coupole.kinematics` uses, so that each checks the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

State = tuple[float, float, float]
"""Path parameter, its speed (1/s) and acceleration (1/s2)."""


_LEAST_MOTION_DEG = 1e-6
"""Least motion that is made; it is a controller's resolution."""


@dataclass(frozen=True)
class Motion:
    """Motion of the axes: `joints_deg(t)` for any time after its start; after its end they are at rest."""

    start_deg: tuple[float, ...]
    line_deg: tuple[float, ...]
    """Turn of each axis from path parameter 0 to 1."""
    begin: State
    phases: tuple[tuple[float, float], ...]
    """Duration (s) and jerk (1/s3) of each stretch of constant jerk."""

    @property
    def duration_s(self) -> float:
        return sum(seconds for seconds, _ in self.phases)

    def state(self, t_s: float) -> State:
        s, v, a = self.begin
        for seconds, jerk in self.phases:
            t = max(0.0, min(t_s, seconds))
            s, v, a = s + t * (v + t * (a / 2 + t * jerk / 6)), v + t * (a + t * jerk / 2), a + t * jerk
            t_s -= seconds
            if t_s <= 0.0:
                break
        return s, v, a

    def joints_deg(self, t_s: float) -> tuple[float, ...]:
        s, _, _ = self.state(t_s)
        return tuple(start + s * turn for start, turn in zip(self.start_deg, self.line_deg, strict=True))


def standing(joints_deg: Sequence[float]) -> Motion:
    return Motion(tuple(joints_deg), (0.0,) * len(joints_deg), (0.0, 0.0, 0.0), ())


def point_to_point(
    start_deg: Sequence[float],
    target_deg: Sequence[float],
    velocity_deg_s: Sequence[float],
    acceleration_deg_s2: float,
    jerk_deg_s3: float,
) -> Motion:
    """Return a motion from rest to rest. Profile of seven phases; e.g. Biagiotti, Melchiorri, "Trajectory Planning
    for Automatic Machines and Robots" (2008), section 3.4."""
    line_deg = tuple(b - a for a, b in zip(start_deg, target_deg, strict=True))
    longest_deg = max(map(abs, line_deg))
    if longest_deg < _LEAST_MOTION_DEG:
        return standing(target_deg)
    fastest = min(limit / abs(turn) for limit, turn in zip(velocity_deg_s, line_deg, strict=True) if turn)
    a, j = acceleration_deg_s2 / longest_deg, jerk_deg_s3 / longest_deg
    # The highest speed from which the axes can still brake, first with full acceleration, else with less.
    v = min(fastest, a / 2.0 * (math.sqrt((a / j) ** 2 + 4.0 / a) - a / j))
    if v < a * a / j:
        v = min(fastest, (j / 4.0) ** (1.0 / 3.0))
        a = math.sqrt(v * j)
    rise_s, hold_s = a / j, max(0.0, v / a - a / j)
    cruise_s = max(0.0, (1.0 - v * (2.0 * rise_s + hold_s)) / v)
    speed_up = ((rise_s, j), (hold_s, 0.0), (rise_s, -j))
    slow_down = ((rise_s, -j), (hold_s, 0.0), (rise_s, j))
    return Motion(tuple(start_deg), line_deg, (0.0, 0.0, 0.0), (*speed_up, (cruise_s, 0.0), *slow_down))


def braking_motion(motion: Motion, t_s: float, acceleration_deg_s2: float, jerk_deg_s3: float) -> Motion:
    """The same path from time `t_s` on, coming to rest as fast as the limits allow."""
    s, v, acceleration = motion.state(t_s)
    if t_s >= motion.duration_s or v <= 0.0:
        return standing(motion.joints_deg(t_s))
    longest_deg = max(map(abs, motion.line_deg))
    # An arm that already brakes harder keeps that deceleration.
    a = max(acceleration_deg_s2 / longest_deg, -acceleration)
    j = max(jerk_deg_s3 / longest_deg, acceleration * acceleration / (2.0 * v) if acceleration < 0.0 else 0.0)
    # To the greatest deceleration and back to zero: v + a0^2 / 2j = peak^2 / j, or a plateau at the limit.
    to_lose = v + acceleration * acceleration / (2.0 * j)
    peak = min(a, math.sqrt(to_lose * j))
    hold_s = max(0.0, (to_lose - peak * peak / j) / peak)
    phases = ((max(0.0, acceleration + peak) / j, -j), (hold_s, 0.0), (peak / j, j))
    return Motion(motion.start_deg, motion.line_deg, (s, v, acceleration), phases)

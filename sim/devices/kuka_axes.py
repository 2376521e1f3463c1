"""The axes of the KUKA stand-in: commanded angles, displacement, vibration after a stop, brakes.

The commanded axes follow the corrections, unless the real controller would stop: limits of axis angle, speed,
acceleration and jerk, and workspaces. The measured axes are the commanded ones plus the displacement by a push,
plus the vibration after a stop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from sim.devices.kuka_kinematics import AXIS_LIMITS_DEG, AXIS_SPEEDS_DEG_S, flange_pose
from sim.devices.kuka_settings import Box, Settings, Sphere, Workspace

_NOWHERE: tuple[float, ...] = (0.0,) * 6
_TOLERANCE_DEG = 2e-6
"""Tolerance, because corrections have six decimals."""
_STILL_DEG = 1e-5
"""Vibration below this amplitude is ignored, because packets have four decimals."""

Axes6 = tuple[float, ...]


class Axes:
    """The axes of one controller. Call `follow`, `brake` or `stay` once per cycle; times are world time."""

    def __init__(self, settings: Settings, now_ns: int) -> None:
        self.commanded_deg: Axes6 = settings.start_joints_deg
        self.stops = 0
        """Number of times that the axes have come to rest."""
        self.came_from_deg: Axes6 = settings.start_joints_deg
        """The commanded axes at the last stop but one."""
        self._stood_at_deg: Axes6 = settings.start_joints_deg
        self.brakes_closed = False
        self._settings = settings
        self._pushed_deg: Axes6 = _NOWHERE
        self._step_deg: Axes6 = _NOWHERE
        """Step of the axes in the last cycle; below, the change of that step."""
        self._change_deg: Axes6 = _NOWHERE
        self._stood_ns: int | None = now_ns
        """World time at which the commanded axes came to rest, or were last pushed; None while they move."""
        self._swing_deg: Axes6 = _NOWHERE
        """Amplitudes of the vibration at `_stood_ns`."""
        swings = settings.vibration_deg > _STILL_DEG
        self._swings_s = (
            settings.vibration_decay_s * math.log(settings.vibration_deg / _STILL_DEG) if swings else 0.0
        )
        self._speed_limit_deg = [v * settings.cycle_ms / 1e3 + _TOLERANCE_DEG for v in AXIS_SPEEDS_DEG_S]

    def measured_deg(self, now_ns: int) -> Axes6:
        """The axes as measured and reported by the controller."""
        if self._pushed_deg is _NOWHERE and not self._swinging(now_ns):
            return self.commanded_deg
        away_deg = map(float.__add__, self._pushed_deg, self._swung_deg(now_ns))
        return tuple(map(float.__add__, self.commanded_deg, away_deg))

    def settled_since_ns(self, now_ns: int) -> int | None:
        """World time since which the arm has been still; None while it moves or vibrates."""
        if self._stood_ns is None or self._swinging(now_ns):
            return None
        swings_s = self._swings_s if any(self._swing_deg) else 0.0
        return self._stood_ns + round(swings_s * 1e9)

    def follow(self, target_deg: Axes6, now_ns: int) -> str:
        """Move to the target in this cycle. If the controller would stop, nothing moves, and the reason is
        returned."""
        wanted_deg = tuple(map(float.__sub__, target_deg, self.commanded_deg))
        step_deg, fault = self._within_dynamics(wanted_deg)
        if step_deg != wanted_deg:
            target_deg = tuple(map(float.__add__, self.commanded_deg, step_deg))
        if any(step_deg) and not fault:
            fault = self._place_fault(target_deg) or self._speed_fault(step_deg)
        if not fault:
            self._go(target_deg, step_deg, now_ns)
        return fault

    def stay(self, now_ns: int) -> None:
        """Make one cycle at rest."""
        self._go(self.commanded_deg, _NOWHERE, now_ns)

    def brake(self, now_ns: int) -> bool:
        """Make one cycle of the controller's own stop. True once the axes are at rest and the brakes are
        closed."""
        change_deg = self._settings.brake_deg_s2 * (self._settings.cycle_ms / 1e3) ** 2
        step_deg = tuple(math.copysign(max(0.0, abs(s) - change_deg), s) for s in self._step_deg)
        self._go(tuple(map(float.__add__, self.commanded_deg, step_deg)), step_deg, now_ns)
        self.brakes_closed = not any(self._step_deg)
        return self.brakes_closed

    def release(self) -> None:
        """Open the brakes; the present axes, with any displacement, become the commanded ones."""
        self.commanded_deg = tuple(map(float.__add__, self.commanded_deg, self._pushed_deg))
        self._pushed_deg = self._step_deg = self._change_deg = _NOWHERE
        self.brakes_closed = False

    def push(self, by_deg: Sequence[float], now_ns: int) -> None:
        """Displace the arm from the commanded axes."""
        self._pushed_deg = tuple(a + b for a, b in zip(self._pushed_deg, by_deg, strict=True))
        if self._stood_ns is not None:
            self._stood_ns, self._swing_deg = now_ns, _NOWHERE
            self.stops += 1

    def _go(self, target_deg: Axes6, step_deg: Axes6, now_ns: int) -> None:
        if any(step_deg):
            self.commanded_deg = target_deg
            self._stood_ns = None
        elif self._stood_ns is None:
            self._stood_ns = now_ns
            self.stops += 1
            self.came_from_deg, self._stood_at_deg = self._stood_at_deg, self.commanded_deg
            swing_deg = self._settings.vibration_deg
            self._swing_deg = tuple(math.copysign(swing_deg, s) if s else 0.0 for s in self._step_deg)
        self._change_deg = tuple(map(float.__sub__, step_deg, self._step_deg))
        self._step_deg = step_deg

    def _within_dynamics(self, step_deg: Axes6) -> tuple[Axes6, str]:
        """The step limited by acceleration and jerk, or a fault."""
        settings, cycle_s = self._settings, self._settings.cycle_ms / 1e3
        for name, limit, order in (
            ("acceleration", settings.acceleration_limit_deg_s2, 2),
            ("jerk", settings.jerk_limit_deg_s3, 3),
        ):
            if limit is None:
                continue
            # Step without acceleration (or without jerk), and the largest allowed deviation from it.
            before = self._step_deg
            if order == 3:
                before = tuple(map(float.__add__, before, self._change_deg))
            room = limit * cycle_s**order + 2**order * _TOLERANCE_DEG
            for axis, (step, free) in enumerate(zip(step_deg, before, strict=True), start=1):
                if abs(step - free) > room and settings.on_excess == "fault":
                    return step_deg, f"command {name} of A{axis} exceeded: {abs(step - free) / cycle_s**order:.0f}"
            step_deg = tuple(
                max(free - room, min(free + room, step)) for step, free in zip(step_deg, before, strict=True)
            )
        return step_deg, ""

    def _speed_fault(self, step_deg: Axes6) -> str:
        for axis, (step, limit) in enumerate(zip(step_deg, self._speed_limit_deg, strict=True), start=1):
            if not abs(step) <= limit:
                return f"command velocity of A{axis} exceeded: {step:.3f} deg a cycle"
        return ""

    def _place_fault(self, joints_deg: Axes6) -> str:
        for axis, (angle, (low, high)) in enumerate(zip(joints_deg, AXIS_LIMITS_DEG, strict=True), start=1):
            if not low <= angle <= high:
                return f"software limit switch of A{axis}: {angle:.3f} deg"
        if self._settings.workspaces:
            flange_mm = flange_pose(joints_deg)[:3, 3]
            for number, workspace in enumerate(self._settings.workspaces, start=1):
                if _inside(workspace, flange_mm) == (workspace.stops == "inside"):
                    return f"workspace {number} violated: flange at {np.round(flange_mm, 1).tolist()} mm"
        return ""

    def _swinging(self, now_ns: int) -> bool:
        return (
            self._stood_ns is not None and any(self._swing_deg) and now_ns - self._stood_ns < self._swings_s * 1e9
        )

    def _swung_deg(self, now_ns: int) -> Axes6:
        """Damped oscillation about the commanded axes."""
        if self._stood_ns is None or not self._swinging(now_ns):
            return _NOWHERE
        t_s = (now_ns - self._stood_ns) / 1e9
        phase = 2.0 * math.pi * self._settings.vibration_hz * t_s
        share = math.exp(-t_s / self._settings.vibration_decay_s) * math.sin(phase)
        return tuple(share * amplitude for amplitude in self._swing_deg)


def _inside(workspace: Workspace, point_mm: NDArray[np.float64]) -> bool:
    match workspace:
        case Box():
            return bool(np.all(point_mm >= workspace.min_mm) and np.all(point_mm <= workspace.max_mm))
        case Sphere():
            return bool(np.linalg.norm(point_mm - workspace.centre_mm) <= workspace.radius_mm)
        case _:
            assert_never(workspace)

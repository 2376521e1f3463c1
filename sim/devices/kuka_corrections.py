"""Corrections in the KUKA stand-in: computes the target axes, as the objects of an RSI context do.

A correction of the pose adds its translation in base coordinates and rotates the flange about the base's axes:
rotation = Rz(A) Ry(B) Rx(C) * rotation before (POSCORR with RefCorrSys = BASE). Absolute corrections count from
the start of the session, relative ones are summed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, rotation_from_abc
from sim.devices.kuka_kinematics import flange_pose, joints_near, turn
from sim.devices.kuka_settings import Limits, Settings
from sim.devices.newton import rotation_vector

Axes6 = tuple[float, ...]

_NOTHING: Axes6 = (0.0,) * 6


class Corrections:
    """Sum of one session's corrections, and the resulting axes."""

    def __init__(self, settings: Settings) -> None:
        self._relative = settings.mode == "relative"
        self._holds = not self._relative if settings.hold_on is None else settings.hold_on
        self._makes_sum: Any = _AxesSum if settings.corrects == "axes" else _PoseSum
        self._limits = settings.limits
        self._sum: Any = None
        self._last = _NOTHING

    def begin(self, axes_deg: Axes6) -> None:
        """RSI starts with the axes at `axes_deg`."""
        self._sum = self._makes_sum(axes_deg, self._limits)
        self._last = _NOTHING

    @property
    def clamp_text(self) -> str:
        """Values to which the last correction was clamped, as text; empty if it was applied as it came."""
        axis_names: str = self._sum.clamped
        return axis_names

    def take(self, values: Axes6 | None) -> tuple[Axes6, str]:
        """Return the target axes after one cycle's correction, and the reason if RSI stops instead. `values` is
        None if no correction came in time (HOLDON)."""
        if values is None:
            values = self._last if self._holds else _NOTHING
        self._last = values
        fault: str = self._sum.add(values) if self._relative else self._sum.replace(values)
        return self._sum.axes_deg, fault


class _AxesSum:
    """Corrections of the axes: AXISCORR and AXISCORRMON."""

    def __init__(self, axes_deg: Axes6, limits: Limits) -> None:
        self.axes_deg = self._start_deg = axes_deg
        self.clamped = ""
        self._limits = limits
        self._sum_deg: Axes6 = _NOTHING
        self._values: Axes6 | None = None
        """Corrections that were applied last."""

    def add(self, values: Axes6) -> str:
        return self.replace(tuple(map(float.__add__, self._sum_deg, values)))

    def replace(self, values: Axes6) -> str:
        if values == self._values:  # of an arm that stands
            return ""
        clamps = self._limits.axis_clamp_deg
        self._sum_deg = tuple(max(-c, min(c, value)) for c, value in zip(clamps, values, strict=True))
        self.clamped = "" if self._sum_deg == values else f"to {np.round(self._sum_deg, 3).tolist()} deg"
        for axis, (value, most) in enumerate(zip(self._sum_deg, self._limits.axis_monitor_deg, strict=True), 1):
            if not abs(value) <= most:
                return f"AXISCORRMON: correction of A{axis} by {value:.3f} deg"
        self.axes_deg = tuple(map(float.__add__, self._start_deg, self._sum_deg))
        self._values = values
        return ""


class _PoseSum:
    """Corrections of the flange's pose: POSCORR and POSCORRMON."""

    def __init__(self, axes_deg: Axes6, limits: Limits) -> None:
        self.axes_deg = axes_deg
        self.clamped = ""
        self._limits = limits
        self._start: Transform = flange_pose(axes_deg)
        self._moved_mm: NDArray[np.float64] = np.zeros(3)
        self._turned: NDArray[np.float64] = np.eye(3)

    def add(self, values: Axes6) -> str:
        if not any(values):
            return ""
        return self._lead(self._moved_mm + values[:3], _rotation(values) @ self._turned)

    def replace(self, values: Axes6) -> str:
        return self._lead(np.array(values[:3]), _rotation(values))

    def _lead(self, moved_mm: NDArray[np.float64], rotation: NDArray[np.float64]) -> str:
        limits = self._limits
        wanted_mm = moved_mm
        moved_mm = np.clip(moved_mm, -limits.pose_clamp_mm, limits.pose_clamp_mm)
        self.clamped = "" if np.array_equal(moved_mm, wanted_mm) else f"to {np.round(moved_mm, 1).tolist()} mm"
        vector = rotation_vector(rotation)
        angle_deg = float(np.degrees(np.linalg.norm(vector)))
        if angle_deg > limits.pose_clamp_deg:
            angle_deg, rotation = limits.pose_clamp_deg, turn(_unit(vector), limits.pose_clamp_deg)
            self.clamped = f"to a turn of {angle_deg:g} deg"
        if not np.linalg.norm(moved_mm) <= limits.pose_monitor_mm or not angle_deg <= limits.pose_monitor_deg:
            return f"POSCORRMON: correction by {np.round(moved_mm, 1).tolist()} mm, {angle_deg:.1f} deg"
        if np.array_equal(moved_mm, self._moved_mm) and np.array_equal(rotation, self._turned):
            return ""
        self._moved_mm, self._turned = moved_mm, rotation
        base_from_flange = np.eye(4)
        base_from_flange[:3, :3] = rotation @ self._start[:3, :3]
        base_from_flange[:3, 3] = self._start[:3, 3] + moved_mm
        axes_deg = joints_near(base_from_flange, self.axes_deg)
        if axes_deg is None:
            return "the corrected pose has no solution near the axes"
        self.axes_deg = axes_deg
        return ""


def _rotation(values: Axes6) -> NDArray[np.float64]:
    return rotation_from_abc(*values[3:])


def _unit(vector: NDArray[np.float64]) -> Sequence[float]:
    unit: list[float] = (vector / np.linalg.norm(vector)).tolist()
    return unit

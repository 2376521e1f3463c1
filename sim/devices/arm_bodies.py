"""What of the arm and its tool stands in the light: capsules in the base frame.

The stand-in's own picture of the arm, coarser than the controller's and apart from it, on `kuka_kinematics`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from coupole.geometry import Transform
from sim.devices.kuka_kinematics import joint_origins_mm

_COLUMN_MM, _SHOULDER_MM, _UPPER_MM, _FOREARM_MM, _WRIST_MM = 140.0, 150.0, 110.0, 80.0, 55.0
"""Radii, after KUKA's drawing of the KR10 R1100 sixx."""

Capsules = NDArray[np.float64]
"""[n, 7] two ends in the base frame and the radius, mm."""
NONE: Capsules = np.empty((0, 7))


class ToolBody(BaseModel):
    """What the flange carries, in its frame."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    from_mm: tuple[float, float, float]
    to_mm: tuple[float, float, float]
    radius_mm: float


def tool_capsules(base_from_flange: Transform, tool: Sequence[ToolBody]) -> Capsules:
    """The tool alone: of an arm of another make no more is known."""
    ends = np.array([[body.from_mm, body.to_mm] for body in tool]).reshape(-1, 2, 3)
    placed = ends @ base_from_flange[:3, :3].T + base_from_flange[:3, 3]
    return np.column_stack([placed.reshape(-1, 6), [body.radius_mm for body in tool]])


def arm_capsules(joints_deg: Sequence[float]) -> Capsules:
    """Column, shoulder, upper arm, forearm and wrist of the KR10 at these angles."""
    origins = joint_origins_mm(joints_deg)
    chain = [np.zeros(3), origins[0], origins[1], origins[2], origins[4], origins[5]]
    radii = (_COLUMN_MM, _SHOULDER_MM, _UPPER_MM, _FOREARM_MM, _WRIST_MM)
    return np.array([[*a, *b, r] for a, b, r in zip(chain, chain[1:], radii, strict=False)])

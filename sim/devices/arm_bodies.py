"""Parts of arm and tool that block light: capsules in the base frame.

This model is separate from the controller's own and coarser. It is computed with `kuka_kinematics` and `ur_arm`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from coupole.geometry import Transform
from sim.devices import ur_arm
from sim.devices.kuka_kinematics import joint_origins_mm
from sim.devices.ur_arm import UrModel

_COLUMN_MM, _SHOULDER_MM, _UPPER_MM, _FOREARM_MM, _WRIST_MM = 140.0, 150.0, 110.0, 80.0, 55.0
"""Radii, after KUKA's drawing of the KR10 R1100 sixx."""

_UR_RADII_MM: dict[UrModel, dict[str, float]] = {
    "ur5e": {"column": 60.0, "shoulder": 65.0, "upper": 60.0, "forearm": 50.0, "wrist": 45.0},
    "ur10e": {"column": 78.0, "shoulder": 85.0, "upper": 75.0, "forearm": 60.0, "wrist": 48.0},
}
"""Radii from the outlines in Universal Robots' data sheets; each link is widest at its joints' housings."""
_UR_ASIDE_MM: dict[UrModel, tuple[float, float]] = {"ur5e": (138.0, 7.0), "ur10e": (176.0, 39.0)}
"""Distance of upper arm and forearm from the plane of axis 1, along axis 2."""

Capsules = NDArray[np.float64]
"""[n, 7] both ends in the base frame and the radius, mm."""
NONE: Capsules = np.empty((0, 7))


class ToolBody(BaseModel):
    """A capsule on the flange, in the flange frame."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    from_mm: tuple[float, float, float]
    to_mm: tuple[float, float, float]
    radius_mm: float


def tool_capsules(base_from_flange: Transform, tool: Sequence[ToolBody]) -> Capsules:
    """Return the capsules of the tool alone."""
    ends = np.array([[body.from_mm, body.to_mm] for body in tool]).reshape(-1, 2, 3)
    ends_in_base = ends @ base_from_flange[:3, :3].T + base_from_flange[:3, 3]
    return np.column_stack([ends_in_base.reshape(-1, 6), [body.radius_mm for body in tool]])


def arm_capsules(joints_deg: Sequence[float]) -> Capsules:
    """Column, shoulder, upper arm, forearm and wrist of the KR10 at these angles."""
    origins = joint_origins_mm(joints_deg)
    chain = [np.zeros(3), origins[0], origins[1], origins[2], origins[4], origins[5]]
    radii = (_COLUMN_MM, _SHOULDER_MM, _UPPER_MM, _FOREARM_MM, _WRIST_MM)
    return np.array([[*a, *b, r] for a, b, r in zip(chain, chain[1:], radii, strict=False)])


def ur_capsules(model: UrModel, joints_deg: Sequence[float]) -> Capsules:
    """Column, shoulder, upper arm, elbow, forearm and wrist of a UR at these angles."""
    base_from_flange, origins, axes = ur_arm.chain(model, joints_deg)
    radii = _UR_RADII_MM[model]
    upper, fore = (aside * axes[1] for aside in _UR_ASIDE_MM[model])
    parts = (
        (radii["column"] * axes[0], origins[1], radii["column"]),
        (origins[1], origins[1] + upper, radii["shoulder"]),
        (origins[1] + upper, origins[2] + upper, radii["upper"]),
        (origins[2] + upper, origins[2] + fore, radii["upper"]),
        (origins[2] + fore, origins[3] + fore, radii["forearm"]),
        (origins[3] + fore, origins[4], radii["wrist"]),
        (origins[4], origins[5], radii["wrist"]),
        (origins[5], base_from_flange[:3, 3] - radii["wrist"] * base_from_flange[:3, 2], radii["wrist"]),
    )
    return np.array([[*a, *b, radius] for a, b, radius in parts])

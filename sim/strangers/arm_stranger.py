"""An arm whose errors depend on its present and previous place: backlash, sag, a ripple of its gears.

All errors act on the angles: a true angle is the reported angle plus these errors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

Six = tuple[float, float, float, float, float, float]
_NONE: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_LINK_KG = (0.0, 12.0, 6.0, 4.0, 2.0, 1.5)
"""Masses at the joints' origins, of a KR10 R1100 sixx (its 54 kg without base and A1; assumed shares)."""
_TOOL_KG = 2.5
Floats = NDArray[np.float64]


class ArmStranger(BaseModel):
    """Errors of the six axes in degrees."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    backlash_deg: Six = _NONE
    """Play of each axis. The axis stops short by half of the backlash, on the side from which it came."""
    sag_deg_per_nm: Six = _NONE
    """Compliance of each axis under the weight of the parts that it carries."""
    down: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction of gravity in the arm's base: along z for an arm that hangs upside down."""
    ripple_deg: Six = _NONE
    """Amplitude of a periodic error of each axis's gear."""
    ripple_periods: Six = (80.0, 100.0, 80.0, 50.0, 50.0, 50.0)
    """Number of periods per turn of the axis."""
    ripple_phase_deg: Six = _NONE

    def errors_deg(
        self, joints_deg: Sequence[float], came_from_deg: Sequence[float], origins_mm: Floats, axes: Floats
    ) -> Floats:
        """[6] true less reported angles. `came_from_deg` are the angles at the stop before; `origins_mm` [7, 3]
        and `axes` [6, 3] are the origins and axes of the joints in the base, with the flange's origin last."""
        joints = np.asarray(joints_deg, dtype=np.float64)
        short = -0.5 * np.array(self.backlash_deg) * np.sign(joints - np.asarray(came_from_deg))
        turn = np.radians(np.array(self.ripple_periods) * joints + np.array(self.ripple_phase_deg))
        ripple = np.array(self.ripple_deg) * np.sin(turn)
        sag = np.array(self.sag_deg_per_nm) * self.torques_nm(origins_mm, axes)
        return np.asarray(short + ripple + sag)

    def torques_nm(self, origins_mm: Floats, axes: Floats) -> Floats:
        """[6] torques of the weight of links and tool about each axis."""
        masses = np.array([*_LINK_KG, _TOOL_KG])
        weight = 9.81 * np.array(self.down) / np.linalg.norm(self.down)
        torques = np.zeros(6)
        for axis in range(6):
            arms_m = 1e-3 * (origins_mm[axis + 1 :] - origins_mm[axis])
            moment = np.cross((masses[axis + 1 :, None] * arms_m).sum(axis=0), weight)
            torques[axis] = moment @ axes[axis]
        return torques


NO_STRANGER = ArmStranger()

"""Causes for which no calibration has a term. They disturb the simulated cell. Modules are named after the
disturbed part.

Each is off until the rig switches it on (`world.settings.strangers`). No calibration knows of them.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from sim.strangers.arm_stranger import ArmStranger
from sim.strangers.lens_stranger import LensStranger
from sim.strangers.light_stranger import LightStranger
from sim.strangers.sensor_stranger import SensorStranger
from sim.strangers.target_stranger import TargetStranger


class Strangers(BaseModel):
    """The rig's `world.settings.strangers`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    lens: LensStranger = LensStranger()
    light: LightStranger = LightStranger()
    target: TargetStranger = TargetStranger()
    arm: ArmStranger = ArmStranger()
    sensor: SensorStranger = SensorStranger()

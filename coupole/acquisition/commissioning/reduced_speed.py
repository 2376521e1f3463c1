"""The rig at reduced speed: no point of arm and tool is faster than 250 mm/s (ISO 10218-1: reduced speed, T1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.motion.collisions import CellBodies
from coupole.plan.registry import settings_class
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import device_for, planning_arm

REDUCED_MM_S = 250.0


def at_reduced_speed(rig: Rig, bodies: CellBodies) -> Rig:
    """Return the rig with a lower speed, so that no point of arm and tool exceeds REDUCED_MM_S in any motion.

    The bound is a sum over the axes: the greatest speed of an axis times the greatest distance of any point from
    it (`CellBodies.reach_mm`). Raises InputError if the arm is not described or its driver cannot be slowed.
    """
    driver, _ = device_for(rig, "robot", dry_run=False)
    if "speed_fraction" not in settings_class(driver).model_fields:
        raise InputError(f"robot {driver}: expected a driver with the setting `speed_fraction`, to go slowly")
    fastest_mm_s = float(np.radians(greatest_speeds_deg_s(_at(rig, 1.0))) @ bodies.reach_mm)
    fraction = min(REDUCED_MM_S / fastest_mm_s, _fraction(rig))
    return _at(rig, np.floor(fraction * 1e4) / 1e4)


def greatest_speeds_deg_s(rig: Rig) -> NDArray[np.float64]:
    """Return the greatest speeds [6] of the axes, in the motions of the rig's driver. Raises InputError if the arm
    is not described."""
    arm = planning_arm(rig)
    if arm is None:
        raise InputError("expected a described arm (`arm:` in the rig): its reach determines the slow speed")
    return np.array(arm.velocity_deg_s)


def _fraction(rig: Rig) -> float:
    return float(rig.robot.settings.get("speed_fraction", rig.motion.speed_fraction))


def _at(rig: Rig, fraction: float) -> Rig:
    settings = {**rig.robot.settings, "speed_fraction": float(fraction)}
    return rig.model_copy(update={"robot": rig.robot.model_copy(update={"settings": settings})})

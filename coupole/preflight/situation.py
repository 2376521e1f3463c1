"""Conditions for which a rig's calibration records must be valid."""

from __future__ import annotations

from datetime import UTC, datetime

from coupole.calibration.in_force import Situation
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import in_world


def situation_of(rig: Rig, *, camera: str | None = None, temperature_c: float | None = None) -> Situation:
    """Return the present conditions for which this rig's records must be valid."""
    return Situation(
        now=datetime.now(UTC),
        is_simulated=in_world(rig, dry_run=False),
        size_px=(rig.sensor.width_px, rig.sensor.height_px),
        focal_length_mm=rig.lens.focal_length_mm,
        focus_distance_mm=rig.lens.focus_distance_mm,
        f_number=rig.lens.f_number,
        camera=camera,
        temperature_c=temperature_c,
    )

"""Rigs for tests of calibrations: the shipped imperfect cell, smaller and faster."""

from __future__ import annotations

from typing import Any

import cells
from places import REPO


def imperfect_rig(width_px: int, speed: float) -> dict[str, Any]:
    """Data of the shipped imperfect cell with smaller frames of the same field of view, and faster than life. Its
    arm has a cycle of 12 ms: in worlds at such speeds most of the work is cycles, of an arm that stands."""
    rig = cells.shipped_rig("sim-imperfect")
    shipped_px = rig["sensor"]["width_px"]
    pitch_um = rig["sensor"]["pixel_pitch_um"] * shipped_px / width_px
    rig["sensor"] |= {"width_px": width_px, "height_px": width_px * 3 // 4, "pixel_pitch_um": pitch_um}
    rig["dome"]["leds"] = str(REPO / "configs/domes/coupole.csv")
    rig["ledbox"]["settings"]["watchdog_s"] = 60.0
    rig["robot"]["settings"]["cycle_ms"] = rig["world"]["settings"]["robot"]["cycle_ms"] = 12
    rig["world"]["settings"]["speed"] = speed
    return rig

"""Acceptance limits of the LEDs' positions."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

LEDS = (
    Allowed("missing", "LEDs not found", 0.02),
    Allowed("centre_mm", "median centre", 0.7, "mm"),
    Allowed("normal_deg", "median normal", 0.21, "deg"),
    Allowed("robot_ratio", "ratio of the robot's estimated noise to its stated noise", 3.0),
    Allowed("rejected", "spots left out", 0.05),
    Allowed("record_step", "distance of camera and hand-eye from their record, in standard uncertainties", 4.0),
    Allowed("image_away", "shift of the dies' images away from the camera, in standard uncertainties", 4.0),
    Allowed("left_out", "ratio of the uncertainty found by leaving out views to the stated uncertainty", 2.0),
)
"""`centre_mm`, `normal_deg`: standard uncertainties (Lucat et al. 2025: 700 um, 0.21 deg). `left_out` is for the
centres, the median over the LEDs."""

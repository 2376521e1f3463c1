"""Acceptance limits of a lens and of a camera on a robot."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

IMAGES = (
    Allowed("pixel_px", "noise of corners", 0.3, "px"),
    Allowed("bare_field", "field without corners", 0.4),
    Allowed("rejected", "corners left out", 0.05),
    Allowed("clipped", "images that are too clipped to find corners", 0.2),
)
"""`bare_field` is the share of the field's 8 x 6 cells without corners. `rejected` is the share of the corners
left out as gross errors."""
DOUBTS = (
    Allowed("pattern", "lens: ratio of the error of the model's form to its uncertainty", 1.0),
    Allowed("predicted", "ratio of the error of predicted views to their stated uncertainty", 1.5),
)
"""`pattern` is the root mean square over the field of the change that a richer lens would make, divided by the
standard uncertainty of a direction's image. `predicted` is for all views, each of which is left out in turn."""
CAMERA = (*IMAGES, *DOUBTS, Allowed("ray_px", "uncertainty at the field's corners", 0.5, "px"))
"""`ray_px` is the standard uncertainty of the image of a direction at the field's corners."""
HAND_EYE = (
    *IMAGES,
    *DOUBTS,
    Allowed("centre_mm", "camera centre on the flange", 0.3, "mm"),
    Allowed("turn_deg", "camera's turn", 0.05, "deg"),
    Allowed("robot_ratio", "ratio of the robot's estimated noise to its stated noise", 3.0),
)
"""`centre_mm` is a standard uncertainty, all directions together (Lucat et al. 2025: 300 um)."""
CHROMATIC = (
    *IMAGES,
    Allowed("shift_px", "uncertainty of the shift between colours", 0.1, "px"),
)
"""`shift_px` is a standard uncertainty, the largest over the field."""

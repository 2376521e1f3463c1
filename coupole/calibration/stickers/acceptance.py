"""Acceptance limits of a mesh's pose."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

MESH = (
    Allowed("place_mm", "place of the worst sticker", 0.1, "mm"),
    Allowed("missing", "stickers not found", 0.5),
    Allowed("residual_px", "residual of stickers", 0.5, "px"),
    Allowed("robot_ratio", "ratio of the robot's estimated noise to its stated noise", 3.0),
)
"""`place_mm` is the standard uncertainty of the place of the worst sticker in the base frame (Lucat et al. 2025:
100 um)."""

"""Acceptance limits of the radiometric calibrations. Uncertainties are relative."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

DARK = (Allowed("hot", "share of hot pixels", 1e-3),)
RESPONSE = (
    Allowed("linearity", "uncertainty of linearity", 0.003),
    Allowed("flicker", "flicker of the light", 0.005),
)
LED_POWER = (
    Allowed("power", "median uncertainty against the mean", 0.02),
    Allowed("unusable", "share of LEDs without a usable picture", 0.02),
)
DRIFT = (
    Allowed("factor", "uncertainty of the factor, worst frame", 0.01),
    Allowed("left_out", "share of readings left out", 0.2),
)
GLARE = (
    Allowed("veil", "uncertainty of the veil in the middle of a white picture, as a share of white", 0.001),
    Allowed("left_out", "error of the predicted veil of traps left out, as a share of white", 0.0005),
    Allowed("form", "relative error of the predicted veil of traps left out, worst view", 0.1),
)

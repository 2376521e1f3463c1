"""Acceptance limits of the radiometric calibrations. Uncertainties are relative."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

DARK = (Allowed("hot", "share of hot pixels", 1e-3),)
RESPONSE = (
    Allowed("linearity", "uncertainty of linearity", 0.003),
    Allowed("flicker", "flicker of the light", 0.005),
)
LED_POWER = (
    Allowed("power", "median uncertainty of an LED's power relative to the mean power", 0.02),
    Allowed("unusable", "share of LEDs without a usable picture", 0.02),
    Allowed("left_out", "ratio of the change of powers when views are left out to their uncertainty", 3.0),
    Allowed("scatter", "scatter of an LED between its views", 0.003),
    Allowed("lobe", "share of light that a lobe of the tile reflects", 0.03),
    Allowed("stain", "change of the tile's mean reflectance by a stain, with its uncertainty", 0.01),
    Allowed("drift", "slow change of gain or light within the session", 0.02),
    Allowed("unsteady", "unsteady change of gain or light within the session", 0.002),
)
DRIFT = (
    Allowed("factor", "uncertainty of the drift factor of a frame, greatest value", 0.01),
    Allowed("left_out", "share of readings left out", 0.2),
)
GLARE = (
    Allowed("veil", "uncertainty of the veil in the middle of a white picture, as a share of white", 0.001),
    Allowed("left_out", "error of the predicted veil of traps left out, as a share of white", 0.0005),
    Allowed("form", "relative error of the predicted veil of traps left out, worst view", 0.1),
)

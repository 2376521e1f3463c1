"""Acceptance limits of the colour profile, on CIEDE2000 of patches that were left out of the fit."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

COLOUR = (
    Allowed("mean", "mean CIEDE2000 of patches left out", 4.0),
    Allowed("worst", "largest CIEDE2000 of a patch left out", 10.0),
)

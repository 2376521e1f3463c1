"""Acceptance limits of a check by an independent artefact."""

from __future__ import annotations

from coupole.calibration.acceptance import Allowed

CHECK = (
    Allowed("mean_en", "E_n of the mean over all values", 1.0),
    Allowed("worst_en", "largest E_n of one value", 1.5),
    Allowed("share", "share of values with E_n above 1", 0.1),
)

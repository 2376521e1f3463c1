"""Remarks of a record of LEDs: named suspects, records that do not fit, views that contradict each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coupole.calibration.calibrated_arm import ZEROS, CalibratedArm
from coupole.calibration.leds.adjustment import LedGeometry
from coupole.calibration.leds.sources import LedImages
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.record import Limit


def remarks_of(
    images: LedImages,
    geometry: LedGeometry,
    prior: CameraPrior,
    limits: Sequence[Limit],
    arm: CalibratedArm | None,
) -> list[str]:
    """Remarks for the operator besides the faults of single LEDs."""
    return [
        *(suspect.sentence() for suspect in geometry.suspects if suspect.is_named),
        *_of_records(geometry, prior, limits),
        *_of_views(images.views, geometry, limits),
        *_of_spots(images.left_out),
        *_of_the_arm(arm),
    ]


def _of_records(geometry: LedGeometry, prior: CameraPrior, limits: Sequence[Limit]) -> list[str]:
    if next(limit.is_met for limit in limits if limit.name == "record_step"):
        return []
    names = [*prior.free, *(f"flange_from_camera.{s}" for s in ("x", "y", "z", "rx", "ry", "rz")), *ZEROS]
    worst = int(np.argmax(np.abs(geometry.prior_step)))
    return [
        f"{names[worst]} would have to be {abs(geometry.prior_step[worst]):.0f} standard uncertainties from its "
        "record: the record was made at another focus, or the camera was pushed since then. Calibrate camera and "
        "hand-eye anew"
    ]


def _of_views(names: Sequence[str], geometry: LedGeometry, limits: Sequence[Limit]) -> list[str]:
    limit = next(limit for limit in limits if limit.name == "left_out")
    line = (
        f"views left out in turn move the LEDs by {limit.found:.2f} times the stated uncertainty; "
        f"{names[_worst(geometry)]} is predicted worst by the other views"
    )
    if limit.is_met:
        return [line]
    return [
        f"{line}. Views contradict each other by more than noise, and no suspect explains it. Look for dome, arm "
        "or camera that moved between the views, and for postures in which the arm errs; then take the views anew"
    ]


def _worst(geometry: LedGeometry) -> int:
    return int(np.argmax(geometry.views.ratios))


def _of_the_arm(arm: CalibratedArm | None) -> list[str]:
    if arm is None:
        return []
    return ["poses are corrected by the axis zeros of the hand-eye record; use them with these LEDs"]


def _of_spots(left_out: Sequence[str]) -> list[str]:
    if not left_out:
        return []
    return [f"{len(left_out)} bright regions are not spots, e.g. {left_out[0]}"]

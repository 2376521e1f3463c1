"""Checks whether a plan may be acquired with the calibrations that it names. Pure functions give all reasons
against it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from coupole.calibration.record import Record, read_record
from coupole.errors import InputError, Problem
from coupole.intake.input_files import InputFiles

NEEDED = ("camera", "hand-eye")
"""Kinds that are needed to compute the ray of a pixel in the base frame."""
_SAME = 1e-3
"""Greatest relative difference between equal figures of a rig and a record."""


@dataclass(frozen=True)
class Situation:
    """State of the cell that will take the pictures. A value of None is not known, and is not checked."""

    now: datetime
    """Time now, with a time zone."""
    is_simulated: bool
    size_px: tuple[int, int]
    """Width and height of the camera's frames."""
    focal_length_mm: float
    focus_distance_mm: float
    f_number: float
    camera: str | None = None
    """Model and serial number of the camera, once it is open."""
    temperature_c: float | None = None
    """Temperature of the coolest LED board, which is nearest to the room's temperature."""


@dataclass(frozen=True)
class InForce:
    """A record and the file that it was read from."""

    path: Path
    record: Record


def read_in_force(paths: Sequence[Path], files: InputFiles | None = None) -> tuple[InForce, ...]:
    """Return the records that a plan names, read from `files` if they are given. Raises InputError with the
    problems of all files."""
    records: list[InForce] = []
    problems: list[Problem] = []
    messages: list[str] = []
    for path in paths:
        try:
            records.append(InForce(path, read_record(path, files)))
        except InputError as error:
            problems += error.problems
            messages += [] if error.problems else [str(error)]
    if messages:
        raise InputError("\n".join([*messages, *map(str, problems)]))
    if problems:
        raise InputError(problems)
    return tuple(records)


def refusals(plan_records: Sequence[InForce], here: Situation, needed_kinds: Sequence[str] = NEEDED) -> list[str]:
    """Return the reasons why a plan that names these records must not be acquired here; empty if the plan may be
    acquired."""
    counts = Counter[str](item.record.kind for item in plan_records)
    reasons = [
        f"calibrations: no record of the kind `{kind}` is named" for kind in needed_kinds if not counts[kind]
    ]
    reasons += [f"calibrations: {n} records of the kind `{kind}` are named" for kind, n in counts.items() if n > 1]
    for item in plan_records:
        reasons += [f"{item.path}: {reason}" for reason in _record_refusals(item.record, here)]
    return reasons


def _record_refusals(record: Record, here: Situation) -> list[str]:
    holds, reasons = record.validity, []
    if here.now >= holds.expires:
        reasons.append(f"expired on {holds.expires:%Y-%m-%d %H:%M} UTC. Calibrate anew")
    if here.now < record.created:
        reasons.append(
            f"made on {record.created:%Y-%m-%d %H:%M} UTC, which is in the future. Set this machine's clock"
        )
    if record.simulated and not here.is_simulated:
        reasons.append("made with a simulated camera; this cell is real")
    if here.is_simulated and not record.simulated:
        reasons.append("made in a real cell; this one is simulated")
    reasons += [
        f"not accepted: {limit.what} is {limit.found:.4g} {limit.unit}, at most {limit.limit:.4g} is allowed"
        for limit in record.limits
        if not limit.is_met
    ]
    if holds.focus_distance_mm is not None:
        off_mm = abs(holds.focus_distance_mm - here.focus_distance_mm)
        if off_mm > holds.focus_tolerance_mm:
            reasons.append(
                f"is valid for a focus of {holds.focus_distance_mm:g} mm (within {holds.focus_tolerance_mm:g}); "
                f"the rig is focused at {here.focus_distance_mm:g} mm. "
                "Calibrate at this focus, or turn the ring back"
            )
    for label, unit, valid, rig_figure in (
        ("focal length", " mm", holds.focal_length_mm, here.focal_length_mm),
        ("aperture", "", holds.f_number, here.f_number),
    ):
        if valid is not None and abs(valid - rig_figure) > _SAME * valid:
            reasons.append(f"is valid for {label} {valid:g}{unit}; the rig has {rig_figure:g}{unit}")
    if holds.size_px is not None and holds.size_px != here.size_px:
        reasons.append(
            f"is valid for frames of {holds.size_px[0]} x {holds.size_px[1]} pixels; the camera gives "
            f"{here.size_px[0]} x {here.size_px[1]}"
        )
    if holds.camera is not None and here.camera is not None and holds.camera != here.camera:
        reasons.append(f"is valid for the camera {holds.camera}; this one is {here.camera}")
    if holds.temperature_c is not None and here.temperature_c is not None:
        low, high = holds.temperature_c
        if not low <= here.temperature_c <= high:
            reasons.append(
                f"is valid from {low:g} to {high:g} C; the cell's coolest LED board has {here.temperature_c:g} C. "
                "Wait for that temperature, or calibrate at this one"
            )
    return reasons

"""Earlier records that a calibration uses. They must be accepted, and must be valid for its images."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from pathlib import Path

from coupole.calibration.record import Kind, Record, read_record
from coupole.calibration.sources import About
from coupole.errors import InputError

_SAME_FIGURE = 1e-3
SHAPE_SIGNAL = ("response", "flat-field")
"""Kinds of records that give the signal for a DN value."""
GLARE = "glare"
"""Kind of record whose veil is subtracted from the signal. A record of LEDs' powers says only whether it was
used."""
READ_WITH = "read_with."
"""First part of the name of each figure in a record of the LEDs' powers. Such a figure says whether a kind of
record was used for it: 1, or 0."""


def read_earlier(path: Path, kind: Kind, about: About, size_px: tuple[int, int]) -> Record:
    """Return a record of this kind for images that `about` and `size_px` (width, height) describe.

    Raises InputError for a record of another kind, with exceeded limits, or that has expired; for another camera,
    focus, aperture, frame size or temperature; and for a simulated record for a real cell.
    """
    record = read_accepted(path, kind)
    _refuse_other(path, record, about, size_px)
    return record


def read_accepted(path: Path, kind: Kind) -> Record:
    """Return a record of this kind that met its limits. Raises InputError for any other record."""
    record = read_record(path)
    if record.kind != kind:
        raise InputError(f"{path}: expected a record of the kind `{kind}`, found one of `{record.kind}`")
    failures = [limit for limit in record.limits if not limit.is_met]
    if failures:
        why = "; ".join(
            f"{failure.what} is {failure.found:.3g} {failure.unit}, at most {failure.limit:.3g}"
            for failure in failures
        )
        raise InputError(f"{path}: not accepted: {why}. Calibrate again, or allow more there with --limit")
    return record


def refuse_read_otherwise(path: Path, record: Record, given_kinds: Collection[str]) -> None:
    """Raise InputError if frames would be read differently from those that a record of LEDs' powers was made from.
    This is so if the powers were made with a record of the response, the flat field or the glare and this kind is
    not among `given_kinds`, or if they were made without it and the kind is among them."""
    for kind in (*SHAPE_SIGNAL, GLARE):
        read_with = record.fixed.get(READ_WITH + kind, 0.0 if kind == GLARE else None)
        beside = _made_with(path, record, kind)
        if (read_with or (read_with is None and beside)) and kind not in given_kinds:
            raise InputError(
                f"{path}: was made with a {kind} record; without such a record the frames would be read "
                f"differently, and all results would be wrong. Name {beside or 'it'} too"
            )
        if read_with == 0.0 and kind in given_kinds:
            raise InputError(
                f"{path}: was made without a {kind} record; with such a record the frames would be read "
                "differently, and all results would be wrong. Leave it out, or calibrate the LEDs' powers "
                "again with it"
            )


def _made_with(path: Path, record: Record, kind: str) -> Path | None:
    """Return the record of this kind that was used to make another record, if it lies in the folder of that
    record."""
    input_hashes = {line.sha256 for line in record.inputs if "/" not in line.name}
    for beside in sorted(path.parent.glob("*.yaml")):
        if hashlib.sha256(beside.read_bytes()).hexdigest() in input_hashes:
            try:
                if read_record(beside).kind == kind:
                    return beside
            except InputError:  # no record, such as a tile's description
                continue
    return None


def refuse_same_images(path: Path, record: Record, inputs: Sequence[tuple[str, str]]) -> None:
    """Raise InputError if a record was made from some of these images, because they would count twice."""
    image_hashes = {line.sha256 for line in record.inputs if "/" in line.name}
    if common := [name for name, sha256 in inputs if "/" in name and sha256 in image_hashes]:
        raise InputError(
            f"{path}: was made from the same images ({common[0]}), so these would count twice. Leave this record "
            "out: the lens is estimated from these images anyway"
        )


def _refuse_other(path: Path, record: Record, about: About, size_px: tuple[int, int]) -> None:
    """Raise InputError unless a record is valid for these images: their time, camera, lens, focus, frame size and
    temperature."""
    holds = record.validity
    if about.begun is not None and record.simulated != about.is_simulated:
        record_cell, images_cell = (
            "a simulated cell" if is_simulated else "a real cell"
            for is_simulated in (record.simulated, about.is_simulated)
        )
        raise InputError(f"{path}: was made in {record_cell}; the images are of {images_cell}")
    if about.begun is not None and about.begun >= holds.expires:
        raise InputError(
            f"{path}: expired on {holds.expires:%Y-%m-%d %H:%M} UTC, before these images were taken "
            f"({about.begun:%Y-%m-%d %H:%M}). Calibrate anew"
        )
    if holds.focus_distance_mm is not None and about.focus_distance_mm is not None:
        off_mm = abs(holds.focus_distance_mm - about.focus_distance_mm)
        if off_mm > holds.focus_tolerance_mm:
            raise InputError(
                f"{path}: is valid for a focus of {holds.focus_distance_mm:g} mm, within "
                f"{holds.focus_tolerance_mm:g} mm; the images were taken at {about.focus_distance_mm:g} mm. "
                "Name a record that was made at this focus"
            )
    for label, valid, figure in (
        ("focal length", holds.focal_length_mm, about.focal_length_mm),
        ("f-number", holds.f_number, about.f_number),
    ):
        if valid is not None and figure is not None and abs(valid - figure) > _SAME_FIGURE * valid:
            raise InputError(f"{path}: is valid for {label} {valid:g}; the images were taken with {figure:g}")
    if holds.size_px is not None and holds.size_px != size_px:
        raise InputError(
            f"{path}: is valid for frames of {holds.size_px[0]} x {holds.size_px[1]} pixels; these have "
            f"{size_px[0]} x {size_px[1]}"
        )
    if holds.temperature_c is not None and about.temperature_c is not None:
        low, high = holds.temperature_c
        room = about.temperature_c[0]  # the coolest LED board is nearest to the room's temperature
        if not low <= room <= high:
            raise InputError(
                f"{path}: is valid from {low:g} to {high:g} C; the coolest LED board of these images had "
                f"{room:g} C. Let room, camera and boards come back to that temperature, or calibrate at this one"
            )
    if holds.camera is not None and about.camera is not None and holds.camera != about.camera:
        raise InputError(f"{path}: is valid for the camera {holds.camera}; the images are of {about.camera}")

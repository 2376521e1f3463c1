"""Exif tags of a RAW file of a still camera (CR2, NEF, ARW, DNG): camera, capture time, exposure, sensitivity.

All four are TIFF files. Their first directory points to an Exif directory (Exif 2.32, JEITA CP-3451), and tifffile
reads both. This module exists because LibRaw gives the capture time only in whole seconds.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tifffile


@dataclass(frozen=True)
class Exif:
    """Tags of one picture. Times are on the camera's own clock, in its own time zone, counted from 1970."""

    make: str
    model: str
    serial: str
    """Serial number of the body; empty if the camera does not record it."""
    firmware: str
    taken_ns: int
    """Start of exposure, truncated to `resolution_us`."""
    resolution_us: int
    """Resolution of the time. It is 1,000,000 for a camera that records only whole seconds."""
    exposure_us: float
    iso: int
    """Sensitivity; 0 if the camera does not record it."""


def read_exif(path: Path) -> Exif:
    """Read the tags. Raises ValueError, which names the missing part, for a file of another kind or without a
    capture time."""
    main = _main_tags(path)
    if not isinstance(exif := main.get("ExifTag"), dict):
        raise ValueError("it has no Exif directory (tag 34665)")  # noqa: TRY004  # the file is wrong, not a call
    date_time = _text(exif, "DateTimeOriginal")
    subseconds = _text(exif, "SubsecTimeOriginal")
    return Exif(
        make=_text(main, "Make"),
        model=_text(main, "Model"),
        serial=_text(exif, "BodySerialNumber"),
        firmware=_text(main, "Software"),
        taken_ns=_taken_ns(date_time, subseconds),
        resolution_us=10 ** (6 - len(subseconds[:6])),
        exposure_us=_exposure_us(exif),
        iso=_iso(exif),
    )


def _main_tags(path: Path) -> Mapping[str, Any]:
    """Return the tags of the file's first directory by their tifffile names. `ExifTag` is a mapping of the same
    kind."""
    try:
        with tifffile.TiffFile(path) as file:
            return {tag.name: tag.value for tag in file.pages.first.tags}
    except (ValueError, ArithmeticError, LookupError, TypeError, struct.error) as error:
        # tifffile raises all of these for directories that are damaged
        raise ValueError(
            f"it is not a TIFF that can be read, as CR2, NEF, ARW and DNG files are: {error}"
        ) from error


def _taken_ns(capture_time: str, subseconds: str) -> int:
    try:
        seconds = datetime.strptime(capture_time, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError as error:
        raise ValueError(f"it has no capture time (tag DateTimeOriginal holds {capture_time!r})") from error
    if subseconds and not (subseconds.isascii() and subseconds.isdigit()):
        raise ValueError(f"its fraction of a second is not a number (tag SubSecTimeOriginal holds {subseconds!r})")
    return int(seconds.timestamp()) * 1_000_000_000 + int(subseconds[:6].ljust(6, "0")) * 1000


def _exposure_us(exif: Mapping[str, Any]) -> float:
    match exif.get("ExposureTime"):
        case (int(numerator), int(denominator)) if numerator and denominator:
            return 1e6 * numerator / denominator
        case _:
            raise ValueError("it has no exposure time (tag ExposureTime)")


def _iso(exif: Mapping[str, Any]) -> int:
    """Return the ISO sensitivity, the first if there are several. Raises ValueError if it is not a number."""
    match exif.get("ISOSpeedRatings", exif.get("PhotographicSensitivity", 0)):
        case int(iso) | (int(iso), *_):
            return iso
        case other:
            raise ValueError(f"its ISO is not a whole number (tag PhotographicSensitivity holds {other!r})")


def _text(tags: Mapping[str, Any], name: str) -> str:
    value = tags.get(name, "")
    return value.strip(" \0") if isinstance(value, str) else ""

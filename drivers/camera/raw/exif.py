"""What a RAW file of a still camera says of when and how it was taken: the Exif tags of CR2, NEF, ARW and DNG.

All four are TIFF files whose first directory points to an Exif directory (Exif 2.32, JEITA CP-3451; tag numbers
below are its). LibRaw gives the capture time in whole seconds only, hence this reader.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

_ORDERS = {b"II": "<", b"MM": ">"}
_ASCII, _SHORT, _LONG, _RATIONAL = 2, 3, 4, 5
_BYTES_OF = {_ASCII: 1, _SHORT: 2, _LONG: 4, _RATIONAL: 8}
_MAKE, _MODEL, _SOFTWARE, _EXIF = 0x010F, 0x0110, 0x0131, 0x8769
_EXPOSURE_TIME, _ISO, _TAKEN, _SUBSECONDS, _BODY_SERIAL = 0x829A, 0x8827, 0x9003, 0x9291, 0xA431
_MAX_VALUE_BYTES = 4096
"""Longer values are none of those that are wanted."""

Value = str | int | tuple[int, int]


@dataclass(frozen=True)
class Exif:
    """Of one picture. Times are the camera's own clock, whatever zone it is set to, counted from 1970."""

    make: str
    model: str
    serial: str
    """Of the body; empty where the camera does not tell."""
    firmware: str
    taken_ns: int
    """Start of exposure, cut off to `resolution_us`."""
    resolution_us: int
    """1,000,000 for a camera that tells whole seconds only."""
    exposure_us: float
    iso: int
    """0 where the camera does not tell."""


def read_exif(path: Path) -> Exif:
    """Raises ValueError, saying what is missing, for a file that is no such RAW or has no capture time."""
    with path.open("rb") as file:
        header = file.read(8)
        order = _ORDERS.get(header[:2])
        if order is None or len(header) < 8:
            raise ValueError("it is no TIFF, as CR2, NEF, ARW and DNG files are")
        main = _directory(file, order, struct.unpack(order + "I", header[4:])[0])
        exif = _directory(file, order, _whole(main, _EXIF))
    taken = _text(exif, _TAKEN)
    subseconds = _text(exif, _SUBSECONDS)
    return Exif(
        make=_text(main, _MAKE),
        model=_text(main, _MODEL),
        serial=_text(exif, _BODY_SERIAL),
        firmware=_text(main, _SOFTWARE),
        taken_ns=_taken_ns(taken, subseconds),
        resolution_us=10 ** (6 - len(subseconds[:6])),
        exposure_us=_exposure_us(exif),
        iso=_whole(exif, _ISO) if _ISO in exif else 0,
    )


def _taken_ns(taken: str, subseconds: str) -> int:
    try:
        seconds = datetime.strptime(taken, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError as error:
        raise ValueError(f"it has no capture time (tag DateTimeOriginal holds {taken!r})") from error
    if subseconds and not (subseconds.isascii() and subseconds.isdigit()):
        raise ValueError(f"its fraction of a second is no number (tag SubSecTimeOriginal holds {subseconds!r})")
    return int(seconds.timestamp()) * 1_000_000_000 + int(subseconds[:6].ljust(6, "0")) * 1000


def _exposure_us(exif: Mapping[int, Value]) -> float:
    match exif.get(_EXPOSURE_TIME):
        case (int(numerator), int(denominator)) if numerator and denominator:
            return 1e6 * numerator / denominator
        case _:
            raise ValueError("it has no exposure time (tag ExposureTime)")


def _text(tags: Mapping[int, Value], tag: int) -> str:
    value = tags.get(tag, "")
    return value.strip(" \0") if isinstance(value, str) else ""


def _whole(tags: Mapping[int, Value], tag: int) -> int:
    match tags.get(tag):
        case int(value):
            return value
        case _:
            raise ValueError(f"it has no whole number in tag {tag}")


def _directory(file: BinaryIO, order: str, offset: int) -> dict[int, Value]:
    """Texts, whole numbers and fractions of one directory; of lists, the first. Other kinds are left out."""
    (count,) = struct.unpack(order + "H", _read(file, offset, 2))
    entries = _read(file, offset + 2, 12 * count)
    tags: dict[int, Value] = {}
    for tag, kind, length, place in struct.iter_unpack(order + "HHI4s", entries):
        size = _BYTES_OF.get(kind, 0) * length
        if 0 < size <= _MAX_VALUE_BYTES:
            data = place if size <= 4 else _read(file, struct.unpack(order + "I", place)[0], size)
            tags[tag] = _value(order, kind, data[:size])
    return tags


def _value(order: str, kind: int, data: bytes) -> Value:
    if kind == _ASCII:
        return data.split(b"\0")[0].decode("utf-8", errors="replace")
    if kind == _RATIONAL:
        numerator, denominator = struct.unpack_from(order + "II", data)
        return (numerator, denominator)
    value: int = struct.unpack_from(order + ("H" if kind == _SHORT else "I"), data)[0]
    return value


def _read(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset, os.SEEK_SET)
    data = file.read(size)
    if len(data) != size:
        raise ValueError(f"it ends before byte {offset + size}, where a tag points")
    return data

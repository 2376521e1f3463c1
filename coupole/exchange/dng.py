"""A frame as DNG (Adobe, Digital Negative Specification 1.4), for LibRaw, darktable, RawTherapee.

The pixels are the camera's, bit for bit: uncompressed, packed if they have 12 bits, otherwise 16 bits each.
Exposure, lens and time are in the Exif directory. If the camera's colours are not known, the colour matrix is the
identity, and the file states that the colours are those of the sensor.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction

import numpy as np

import coupole
from coupole.errors import InputError
from coupole.exchange.camera_colour import D65_CODE, CameraColour, unknown_colour
from coupole.exchange.exported_frame import Picture
from coupole.storage.packing import pack12

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_CFA, _LINEAR_RAW = 32803, 34892
_HEADER_BYTES, _ENTRY_BYTES = 8, 12
_STRIP_OFFSETS, _EXIF = 273, 34665
"""Tags whose values are offsets in the file."""


@dataclass(frozen=True)
class Tag:
    """One entry of the image's directory; `data` holds `count` values of `kind`, little-endian."""

    number: int
    kind: int
    count: int
    data: bytes


def encode(picture: Picture, colour: CameraColour | None = None) -> bytes:
    """Return the whole file: header, two directories, each with the values that do not fit into it, and one strip
    of pixels. Raises InputError if colours are given for a camera without colours."""
    if colour is not None and picture.pattern == "MONO":
        raise InputError("--sensor-spectra: the camera's pattern is MONO; it has no colours")
    height, width = picture.pixels.shape
    twelve = width % 2 == 0 and max(picture.white_dn, int(picture.pixels.max())) < 4096
    strip = pack12(picture.pixels, "msb").tobytes() if twelve else picture.pixels.astype("<u2").tobytes()
    camera_colour = colour or unknown_colour()
    tags = [
        *_image_tags(height, width, bits=12 if twelve else 16, strip_bytes=len(strip)),
        *_camera_tags(picture, camera_colour),
        *(_colour_tags(picture, camera_colour) if picture.pattern != "MONO" else [_short(262, _LINEAR_RAW)]),
    ]
    exif_at = _HEADER_BYTES + _size(tags)
    exif = _exif_tags(picture)
    strip_at = exif_at + _size(exif)
    first = _directory(tags, _HEADER_BYTES, {_STRIP_OFFSETS: strip_at, _EXIF: exif_at})
    return b"".join([struct.pack("<2sHI", b"II", 42, _HEADER_BYTES), first, _directory(exif, exif_at, {}), strip])


def _image_tags(height: int, width: int, *, bits: int, strip_bytes: int) -> list[Tag]:
    return [
        _long(254, 0),  # NewSubfileType: the main image
        _long(256, width),
        _long(257, height),
        _short(258, bits),
        _short(259, 1),  # Compression: none
        _long(_STRIP_OFFSETS, 0),
        _long(_EXIF, 0),
        _short(274, 1),  # Orientation: not rotated
        _short(277, 1),  # SamplesPerPixel
        _long(278, height),  # RowsPerStrip
        _long(279, strip_bytes),
        _short(284, 1),  # PlanarConfiguration
        Tag(50706, _BYTE, 4, bytes([1, 4, 0, 0])),  # DNGVersion
        Tag(50707, _BYTE, 4, bytes([1, 1, 0, 0])),  # DNGBackwardVersion
    ]


def _camera_tags(picture: Picture, colour: CameraColour) -> list[Tag]:
    origin = "none: the sensor has no filters" if picture.pattern == "MONO" else colour.origin
    about = {**picture.about, "bayer_pattern": picture.pattern, "colour": origin}
    camera = str(about.get("camera", "unknown camera")) + (" (simulated)" if about["simulated"] else "")
    return [
        _ascii(270, json.dumps(about)),  # ImageDescription
        _ascii(271, "La Coupole"),  # Make
        _ascii(272, camera),  # Model
        _rationals(282, [Fraction(72)]),  # XResolution
        _rationals(283, [Fraction(72)]),  # YResolution
        _short(296, 2),  # ResolutionUnit: inch
        _ascii(305, f"coupole {coupole.__version__}"),  # Software
        *_times(picture, 306),  # DateTime
        _ascii(50708, f"La Coupole {camera}"),  # UniqueCameraModel
        _short(50713, 1, 1),  # BlackLevelRepeatDim
        _long(50714, picture.black_dn),
        _long(50717, picture.white_dn),
    ]


def _exif_tags(picture: Picture) -> list[Tag]:
    """Exif 2.31: UTC, and the known facts of the lens."""
    tags = [
        _rationals(33434, [Fraction(picture.exposure_us, 1_000_000)]),  # ExposureTime, s
        Tag(36864, _UNDEFINED, 4, b"0231"),  # ExifVersion
        *_times(picture, 36867),  # DateTimeOriginal
    ]
    f_number, focal_mm = (float(picture.about.get(key) or 0.0) for key in ("f_number", "focal_length_mm"))
    if f_number:
        tags.append(_rationals(33437, [_fraction(f_number)]))  # FNumber
    if picture.taken_utc:
        tags.append(_ascii(36881, "+00:00"))  # OffsetTimeOriginal
    if focal_mm:
        tags.append(_rationals(37386, [_fraction(focal_mm)]))  # FocalLength, mm
        tags.append(_ascii(42036, f"{focal_mm:g} mm" + (f" f/{f_number:g}" if f_number else "")))  # LensModel
    return tags


def _times(picture: Picture, number: int) -> list[Tag]:
    if not picture.taken_utc:
        return []
    return [_ascii(number, f"{datetime.fromisoformat(picture.taken_utc).astimezone(UTC):%Y:%m:%d %H:%M:%S}")]


def _colour_tags(picture: Picture, colour: CameraColour) -> list[Tag]:
    """Return the tags of colour. If colours are known, ColorMatrix1 maps XYZ under D65 to the channels' values
    under the LED."""
    neutral = colour.neutral(picture.about.get("led"))
    matrix = np.eye(3)
    if colour.xyz_from_balanced is not None:
        matrix = neutral[:, None] * np.linalg.inv(colour.xyz_from_balanced)
    return [
        _short(262, _CFA),
        _short(33421, 2, 2),  # CFARepeatPatternDim
        Tag(33422, _BYTE, 4, bytes("RGB".index(letter) for letter in picture.pattern)),
        Tag(50710, _BYTE, 3, bytes([0, 1, 2])),  # CFAPlaneColor
        _short(50711, 1),  # CFALayout: rectangular
        _rationals(50721, [_fraction(value) for value in matrix.ravel()], _SRATIONAL),  # ColorMatrix1
        _rationals(50728, [_fraction(value) for value in neutral]),  # AsShotNeutral
        _short(50778, 0 if colour.xyz_from_balanced is None else D65_CODE),  # CalibrationIlluminant1
    ]


def _size(tags: list[Tag]) -> int:
    """Number of bytes of a directory and its values; even."""
    return (
        2
        + _ENTRY_BYTES * len(tags)
        + 4
        + sum(len(tag.data) + len(tag.data) % 2 for tag in tags if len(tag.data) > 4)
    )


def _directory(tags: list[Tag], at: int, places: dict[int, int]) -> bytes:
    """Return a directory that begins at the byte `at`, without a next one, and its values. `places` are tags whose
    value is an offset in the file."""
    values_at = at + 2 + _ENTRY_BYTES * len(tags) + 4
    values = bytearray()
    entries = [struct.pack("<H", len(tags))]
    for tag in sorted(tags, key=lambda t: t.number):
        if tag.number in places:
            data = struct.pack("<I", places[tag.number])
        elif len(tag.data) > 4:
            data = struct.pack("<I", values_at + len(values))
            values += tag.data + b"\0" * (len(tag.data) % 2)
        else:
            data = tag.data.ljust(4, b"\0")
        entries.append(struct.pack("<HHI", tag.number, tag.kind, tag.count) + data)
    entries.append(struct.pack("<I", 0))
    return b"".join(entries) + bytes(values)


def _fraction(value: float) -> Fraction:
    return Fraction(value).limit_denominator(10_000)


def _short(number: int, *values: int) -> Tag:
    return Tag(number, _SHORT, len(values), np.array(values, "<u2").tobytes())


def _long(number: int, *values: int) -> Tag:
    return Tag(number, _LONG, len(values), np.array(values, "<u4").tobytes())


def _ascii(number: int, text: str) -> Tag:
    data = text.encode("ascii", "replace") + b"\0"
    return Tag(number, _ASCII, len(data), data)


def _rationals(number: int, values: list[Fraction], kind: int = _RATIONAL) -> Tag:
    pairs = [part for value in values for part in (value.numerator, value.denominator)]
    return Tag(number, kind, len(values), np.array(pairs, "<i4").tobytes())

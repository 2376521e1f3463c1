"""A frame as DNG (Adobe, Digital Negative Specification 1.4), for LibRaw, darktable, RawTherapee.

The pixels are the camera's, bit for bit: uncompressed, packed if they have 12 bits, else 16 bits each. There is no
colour calibration, so the colour matrix is the identity, which the file states: colours are those of the sensor.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

import coupole
from coupole.exchange.exported_frame import Picture
from coupole.storage.packing import pack12

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL = 1, 2, 3, 4, 5, 10
_CFA, _LINEAR_RAW = 32803, 34892
_UNCALIBRATED = "not calibrated: ColorMatrix1 is the identity, AsShotNeutral is 1 1 1"
_HEADER_BYTES, _ENTRY_BYTES = 8, 12


@dataclass(frozen=True)
class Tag:
    """One entry of the image's directory; `data` holds `count` values of `kind`, little-endian."""

    number: int
    kind: int
    count: int
    data: bytes


def encode(picture: Picture) -> bytes:
    """The whole file: header, directory, values that do not fit into it, one strip of pixels."""
    height, width = picture.pixels.shape
    twelve = width % 2 == 0 and max(picture.white_dn, int(picture.pixels.max())) < 4096
    strip = pack12(picture.pixels, "msb").tobytes() if twelve else picture.pixels.astype("<u2").tobytes()
    tags = [
        *_image_tags(height, width, bits=12 if twelve else 16, strip_bytes=len(strip)),
        *_camera_tags(picture),
        *(_colour_tags(picture.pattern) if picture.pattern != "MONO" else [_short(262, _LINEAR_RAW)]),
    ]
    directory, values, strip_offset = _lay_out(tags)
    header = struct.pack("<2sHI", b"II", 42, _HEADER_BYTES)
    return b"".join([header, directory, values, b"\0" * (strip_offset % 2), strip])


def _image_tags(height: int, width: int, *, bits: int, strip_bytes: int) -> list[Tag]:
    return [
        _long(254, 0),  # NewSubfileType: the main image
        _long(256, width),
        _long(257, height),
        _short(258, bits),
        _short(259, 1),  # Compression: none
        _STRIP_OFFSET,
        _short(274, 1),  # Orientation: not rotated
        _short(277, 1),  # SamplesPerPixel
        _long(278, height),  # RowsPerStrip
        _long(279, strip_bytes),
        _short(284, 1),  # PlanarConfiguration
        Tag(50706, _BYTE, 4, bytes([1, 4, 0, 0])),  # DNGVersion
        Tag(50707, _BYTE, 4, bytes([1, 1, 0, 0])),  # DNGBackwardVersion
    ]


def _camera_tags(picture: Picture) -> list[Tag]:
    about = {**picture.about, "bayer_pattern": picture.pattern, "colour": _UNCALIBRATED}
    camera = str(about.get("camera", "unknown camera")) + (" (simulated)" if about["simulated"] else "")
    tags = [
        _ascii(270, json.dumps(about)),  # ImageDescription
        _ascii(271, "La Coupole"),  # Make
        _ascii(272, camera),  # Model
        _ascii(305, f"coupole {coupole.__version__}"),  # Software
        _rationals(33434, [Fraction(picture.exposure_us, 1_000_000)]),  # ExposureTime, s
        _ascii(50708, f"La Coupole {camera}"),  # UniqueCameraModel
        _short(50713, 1, 1),  # BlackLevelRepeatDim
        _long(50714, picture.black_dn),
        _long(50717, picture.white_dn),
    ]
    for number, key in ((33437, "f_number"), (37386, "focal_length_mm")):
        if about.get(key):
            tags.append(_rationals(number, [Fraction(about[key]).limit_denominator(10_000)]))
    return tags


def _colour_tags(pattern: str) -> list[Tag]:
    one, nothing = Fraction(1), Fraction(0)
    return [
        _short(262, _CFA),
        _short(33421, 2, 2),  # CFARepeatPatternDim
        Tag(33422, _BYTE, 4, bytes("RGB".index(letter) for letter in pattern)),
        Tag(50710, _BYTE, 3, bytes([0, 1, 2])),  # CFAPlaneColor
        _short(50711, 1),  # CFALayout: rectangular
        _rationals(
            50721, [one if i == j else nothing for i in range(3) for j in range(3)], _SRATIONAL
        ),  # ColorMatrix1
        _rationals(50728, [one] * 3),  # AsShotNeutral
        _short(50778, 0),  # CalibrationIlluminant1: unknown
    ]


def _lay_out(tags: list[Tag]) -> tuple[bytes, bytes, int]:
    """The directory, the values after it, and the offset of the strip (even)."""
    values_offset = _HEADER_BYTES + 2 + _ENTRY_BYTES * len(tags) + 4
    values = bytearray()
    offsets = {}
    for tag in tags:
        if len(tag.data) > 4:
            offsets[tag.number] = values_offset + len(values)
            values += tag.data + b"\0" * (len(tag.data) % 2)
    strip_offset = values_offset + len(values)
    entries = [struct.pack("<H", len(tags))]
    for tag in sorted(tags, key=lambda t: t.number):
        if tag is _STRIP_OFFSET:
            data = struct.pack("<I", strip_offset)
        elif tag.number in offsets:
            data = struct.pack("<I", offsets[tag.number])
        else:
            data = tag.data.ljust(4, b"\0")
        entries.append(struct.pack("<HHI", tag.number, tag.kind, tag.count) + data)
    entries.append(struct.pack("<I", 0))  # no further directory
    return b"".join(entries), bytes(values), strip_offset


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


_STRIP_OFFSET = _long(273, 0)
"""StripOffsets: a placeholder until everything else is laid out."""

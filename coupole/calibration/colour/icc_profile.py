"""A camera's profile as ICC.1:2022 (version 4.4): an input profile from balanced linear channels to XYZ under D50.

The device's red, green, blue are linear, and are 1 for the perfect white. Matrix and curves (8.3.3) are always
written. A root-polynomial is also written as `A2B0` (10.12, lutAToBType): roots of the channels, a table of roots
of X, Y, Z over them, and powers. So the table is finer in the dark, like L*.
"""

from __future__ import annotations

import hashlib
import struct
from datetime import UTC, datetime

import numpy as np

from coupole.calibration.colour.colorimetry import D50_WHITE
from coupole.calibration.colour.colour_profile import Profile
from coupole.calibration.rotations import Floats

_GRID, _POWER = 49, 2.5
"""Number of points of the table's grid along each axis, and exponent of their spacing. They are a compromise
between errors in bright and in dark colours: the errors are below 0.06 in L*, a*, b* for the simulated chart's
patches, and below 0.13 at a twentieth of their light."""
_HEAD_BYTES, _TAG_BYTES = 128, 12
_LARGEST_XYZ = 1.0 + 32767.0 / 32768.0
"""The value of the largest code of X, Y, Z (ICC.1:2022, 6.3.4.2)."""


def icc_profile(chosen_profile: Profile, matrix: Profile, name: str, creation_time: datetime) -> bytes:
    """Return the whole file. `chosen_profile` goes into the table if it is a root-polynomial; `matrix` goes into
    matrix and curves. `name` is the profile's description, in ASCII."""
    columns = matrix.coefficients.T
    tags: dict[bytes, bytes] = {
        b"desc": _text(name),
        b"cprt": _text("No copyright; use freely"),
        b"wtpt": _xyz(D50_WHITE),
        b"rXYZ": _xyz(columns[0]),
        b"gXYZ": _xyz(columns[1]),
        b"bXYZ": _xyz(columns[2]),
    }
    linear = b"curv" + bytes(8)
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), linear)
    if chosen_profile.form != "matrix":
        tags[b"A2B0"] = _table(chosen_profile)
    return _file(tags, creation_time)


def _file(tags: dict[bytes, bytes], creation_time: datetime) -> bytes:
    start = _HEAD_BYTES + 4 + _TAG_BYTES * len(tags)
    tag_table, content = struct.pack(">I", len(tags)), b""
    places: dict[bytes, int] = {}
    for name, data in tags.items():
        if data not in places:
            places[data] = start + len(content)
            content += data + bytes(-len(data) % 4)
        tag_table += struct.pack(">4sII", name, places[data], len(data))
    when = creation_time.astimezone(UTC)
    head = struct.pack(
        ">I4sI4s4s4s6H4s4sI4sIQI12s4s",
        start + len(content), bytes(4), 0x04400000, b"scnr", b"RGB ", b"XYZ ",
        when.year, when.month, when.day, when.hour, when.minute, when.second,
        b"acsp", bytes(4), 0, bytes(4), 0, 0, 0, _s15_fixed16(D50_WHITE), bytes(4),
    )  # fmt: skip
    whole = head + bytes(_HEAD_BYTES - len(head)) + tag_table + content
    # The identity is over the file without flags, rendering intent and itself (7.2.18), which are 0 here.
    return whole[:84] + hashlib.md5(whole, usedforsecurity=False).digest() + whole[100:]


def _s15_fixed16(values: Floats) -> bytes:
    """s15Fixed16Number."""
    return np.rint(np.asarray(values) * 65536.0).astype(">i4").tobytes()


def _xyz(values: Floats) -> bytes:
    return b"XYZ " + bytes(4) + _s15_fixed16(values)


def _text(text: str) -> bytes:
    """multiLocalizedUnicodeType with one English text."""
    utf16 = text.encode("utf-16-be")
    return b"mluc" + bytes(4) + struct.pack(">II4sII", 1, 12, b"enUS", len(utf16), 28) + utf16


def _power(exponent: float) -> bytes:
    """parametricCurveType 0: x to the exponent."""
    return b"para" + bytes(8) + _s15_fixed16(np.array([exponent]))


def _table(profile: Profile) -> bytes:
    """lutAToBType: A curves, table, M curves, identity, identity."""
    axis = np.linspace(0.0, 1.0, _GRID) ** _POWER
    red, green, blue = np.meshgrid(axis, axis, axis, indexing="ij")
    xyz = profile.xyz_of_balanced(np.stack([red, green, blue], axis=-1).reshape(-1, 3))
    codes = np.rint(65535.0 * np.clip(xyz / _LARGEST_XYZ, 0.0, 1.0) ** (1.0 / _POWER)).astype(">u2")
    identity, powers, roots = (curve * 3 for curve in (b"curv" + bytes(8), _power(_POWER), _power(1.0 / _POWER)))
    matrix = _s15_fixed16(np.concatenate([np.eye(3).ravel(), np.zeros(3)]))
    grid = bytes([_GRID] * 3 + [0] * 13) + struct.pack(">B3x", 2) + codes.tobytes()
    grid += bytes(-len(grid) % 4)
    at = 32
    offsets = []
    for part in (identity, matrix, powers, grid, roots):
        offsets.append(at)
        at += len(part)
    return b"mAB " + bytes(4) + struct.pack(">BB2x5I", 3, 3, *offsets) + identity + matrix + powers + grid + roots

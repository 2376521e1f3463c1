"""The smallest DNG that LibRaw opens: a Bayer picture with a still camera's Exif tags, in either byte order."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

BLACK_DN, WHITE_DN = 512, 16_000
_HEADER_BYTES = 8
_Tag = tuple[int, int, int, bytes]


def write_dng(
    path: Path,
    pixels: NDArray[np.uint16],
    *,
    taken: str,
    subseconds: str = "",
    exposure: tuple[int, int] = (1, 125),
    iso: int | tuple[int, ...] = 100,
    model: str = "Still",
    order: str = "<",
) -> None:
    """`pixels` [h, w], RGGB; `taken` as Exif has it, `2026:03:04 05:06:07`; `exposure` a fraction of a second."""
    height, width = pixels.shape

    def text(tag: int, value: str) -> _Tag:
        data = value.encode() + b"\0"
        return (tag, 2, len(data), data)

    def short(tag: int, *values: int) -> _Tag:
        return (tag, 3, len(values), struct.pack(f"{order}{len(values)}H", *values))

    def long(tag: int, value: int) -> _Tag:
        return (tag, 4, 1, struct.pack(order + "I", value))

    strip = pixels.astype(order + "u2").tobytes()
    exif = [
        (0x829A, 5, 1, struct.pack(order + "II", *exposure)),
        short(0x8827, *(iso if isinstance(iso, tuple) else (iso,))),
        text(0x9003, taken),
        *([text(0x9291, subseconds)] if subseconds else []),
        text(0xA431, "4711"),
    ]

    def image(strip_at: int, exif_at: int) -> list[_Tag]:
        return [
            long(0x00FE, 0),
            long(0x0100, width),
            long(0x0101, height),
            short(0x0102, 16),
            short(0x0103, 1),  # not compressed
            short(0x0106, 32803),  # colour filter array
            text(0x010F, "Acme"),
            text(0x0110, model),
            long(0x0111, strip_at),
            short(0x0115, 1),
            long(0x0116, height),
            long(0x0117, len(strip)),
            text(0x0131, "1.0"),
            long(0x8769, exif_at),
            short(0x828D, 2, 2),
            (0x828E, 1, 4, bytes([0, 1, 1, 2])),  # RGGB
            (0xC612, 1, 4, bytes([1, 4, 0, 0])),  # DNG 1.4
            text(0xC614, f"Acme {model}"),
            long(0xC61A, BLACK_DN),
            long(0xC61D, WHITE_DN),
        ]

    exif_at = _HEADER_BYTES + len(_directory(image(0, 0), _HEADER_BYTES, order))
    directory = _directory(exif, exif_at, order)
    strip_at = exif_at + len(directory)
    header = struct.pack(order + "2sHI", b"II" if order == "<" else b"MM", 42, _HEADER_BYTES)
    path.write_bytes(header + _directory(image(strip_at, exif_at), _HEADER_BYTES, order) + directory + strip)


def _directory(tags: list[_Tag], at: int, order: str) -> bytes:
    """A directory that begins at byte `at`, and behind it what its entries point to."""
    entries, values = b"", b""
    values_at = at + 2 + 12 * len(tags) + 4
    for tag, kind, count, data in tags:
        if len(data) > 4:
            place = struct.pack(order + "I", values_at + len(values))
            values += data + b"\0" * (len(data) % 2)
        else:
            place = data.ljust(4, b"\0")
        entries += struct.pack(order + "HHI4s", tag, kind, count, place)
    return struct.pack(order + "H", len(tags)) + entries + bytes(4) + values

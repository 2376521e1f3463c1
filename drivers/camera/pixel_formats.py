"""Pixel formats of GenICam cameras (PFNC), and the unpacking of packed pixels to 16-bit numbers.

Formats of 10 to 16 bits in two bytes are used as received. Formats of one byte and packed formats are widened to
16-bit frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

Packing = Literal["two bytes", "one byte", "10p", "12p", "10Packed", "12Packed"]


@dataclass(frozen=True)
class PixelFormat:
    """One supported format."""

    name: str
    code: int
    """PFNC value; bits 16 to 23 are the bits per pixel on the wire."""
    bit_depth: int
    bayer_pattern: str
    """Bayer pattern as in `coupole.devices.FrameFormat`."""
    packing: Packing

    @property
    def wire_bits(self) -> int:
        return self.code >> 16 & 0xFF

    def wire_bytes(self, pixels: int) -> int:
        """Bytes of an image of `pixels` pixels on the wire, without padding."""
        return -(-pixels * self.wire_bits // 8)


_CODES = {
    ("Mono", "MONO"): (0x01080001, 0x01100003, 0x01100005, 0x01100025, 0x01100007, 0x46, 0x47, 0x04, 0x06),
    ("BayerGR", "GRBG"): (0x01080008, 0x0110000C, 0x01100010, 0, 0x0110002E, 0x56, 0x57, 0x26, 0x2A),
    ("BayerRG", "RGGB"): (0x01080009, 0x0110000D, 0x01100011, 0, 0x0110002F, 0x58, 0x59, 0x27, 0x2B),
    ("BayerGB", "GBRG"): (0x0108000A, 0x0110000E, 0x01100012, 0, 0x01100030, 0x54, 0x55, 0x28, 0x2C),
    ("BayerBG", "BGGR"): (0x0108000B, 0x0110000F, 0x01100013, 0, 0x01100031, 0x52, 0x53, 0x29, 0x2D),
}
"""PFNC values by family: 8, 10, 12, 14, 16, 10p, 12p, 10Packed, 12Packed; the last four without bits 16 to 31."""
_COLUMNS: tuple[tuple[str, int, int, Packing], ...] = (
    ("8", 8, 0, "one byte"),
    ("10", 10, 0, "two bytes"),
    ("12", 12, 0, "two bytes"),
    ("14", 14, 0, "two bytes"),
    ("16", 16, 0, "two bytes"),
    ("10p", 10, 0x010A0000, "10p"),
    ("12p", 12, 0x010C0000, "12p"),
    ("10Packed", 10, 0x010C0000, "10Packed"),
    ("12Packed", 12, 0x010C0000, "12Packed"),
)
FORMATS = {
    family + suffix: PixelFormat(family + suffix, size | code, depth, pattern, packing)
    for (family, pattern), codes in _CODES.items()
    for code, (suffix, depth, size, packing) in zip(codes, _COLUMNS, strict=True)
    if code
}
"""Formats by the name that the feature `PixelFormat` has."""


@kernel
def _widen_12p(out, data):  # type: ignore[no-untyped-def]
    """Two pixels in three bytes: a bit stream, least significant bit first."""
    for pair in range(len(out) // 2):
        first, middle, last = data[3 * pair], data[3 * pair + 1], data[3 * pair + 2]
        out[2 * pair] = np.uint16(first) | np.uint16(middle & 15) << np.uint16(8)
        out[2 * pair + 1] = np.uint16(middle) >> np.uint16(4) | np.uint16(last) << np.uint16(4)


@kernel
def _widen_12_packed(out, data):  # type: ignore[no-untyped-def]
    """Two pixels in three bytes: the outer bytes hold the upper eight bits, the middle one the lower four."""
    for pair in range(len(out) // 2):
        first, middle, last = data[3 * pair], data[3 * pair + 1], data[3 * pair + 2]
        out[2 * pair] = np.uint16(first) << np.uint16(4) | np.uint16(middle & 15)
        out[2 * pair + 1] = np.uint16(last) << np.uint16(4) | np.uint16(middle >> 4)


@kernel
def _widen_10p(out, data):  # type: ignore[no-untyped-def]
    """Four pixels in five bytes: a bit stream, least significant bit first."""
    for quad in range(len(out) // 4):
        a, b, c = np.uint16(data[5 * quad]), np.uint16(data[5 * quad + 1]), np.uint16(data[5 * quad + 2])
        d, e = np.uint16(data[5 * quad + 3]), np.uint16(data[5 * quad + 4])
        out[4 * quad] = a | (b & 3) << 8
        out[4 * quad + 1] = b >> 2 | (c & 15) << 6
        out[4 * quad + 2] = c >> 4 | (d & 63) << 4
        out[4 * quad + 3] = d >> 6 | e << 2


@kernel
def _widen_10_packed(out, data):  # type: ignore[no-untyped-def]
    """Two pixels in three bytes: the middle byte holds the lower two bits of each; the bits of the second pixel
    begin at bit 4."""
    for pair in range(len(out) // 2):
        first, middle, last = data[3 * pair], data[3 * pair + 1], data[3 * pair + 2]
        out[2 * pair] = np.uint16(first) << np.uint16(2) | np.uint16(middle & 3)
        out[2 * pair + 1] = np.uint16(last) << np.uint16(2) | np.uint16(middle >> 4 & 3)


@kernel
def _widen_bytes(out, data):  # type: ignore[no-untyped-def]
    for pixel in range(len(out)):
        out[pixel] = data[pixel]


_WIDEN = {
    "one byte": _widen_bytes,
    "10p": _widen_10p,
    "12p": _widen_12p,
    "10Packed": _widen_10_packed,
    "12Packed": _widen_12_packed,
}
_GROUP = {"one byte": 1, "two bytes": 1, "10p": 4, "12p": 2, "10Packed": 2, "12Packed": 2}


def pixels_in_a_group(pixel_format: PixelFormat) -> int:
    """Return the number of pixels that share bytes. The number of pixels of an image must be a multiple of it."""
    return _GROUP[pixel_format.packing]


def widen(out: NDArray[np.uint16], data: NDArray[np.uint8], pixel_format: PixelFormat) -> None:
    """Fill `out` [pixels] with the pixels in `data` [bytes]; not for formats of two bytes."""
    _WIDEN[pixel_format.packing](out, data)

"""Encodes 12-bit pixels in the formats of the simulated GigE Vision camera (PFNC names and layouts)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Layout:
    """Significant bits per pixel, and their packing in bytes."""

    depth: int
    packing: Literal["bytes", "p", "packed"]
    """Whole little-endian bytes; PFNC `p`: a bit stream, least significant first; GigE Vision 1 `Packed`."""


LAYOUTS = {
    0x01080001: Layout(8, "bytes"),  # Mono8
    0x0108000A: Layout(8, "bytes"),  # BayerGB8
    0x010A0046: Layout(10, "p"),  # Mono10p
    0x010A0054: Layout(10, "p"),  # BayerGB10p
    0x01100005: Layout(12, "bytes"),  # Mono12
    0x01100012: Layout(12, "bytes"),  # BayerGB12
    0x010C0047: Layout(12, "p"),  # Mono12p
    0x010C0055: Layout(12, "p"),  # BayerGB12p
    0x010C0006: Layout(12, "packed"),  # Mono12Packed
    0x01100007: Layout(16, "bytes"),  # Mono16
    0x01100030: Layout(16, "bytes"),  # BayerGB16
}


def encode(out: NDArray[np.uint8], frame: NDArray[np.uint16], pixel_format: int, bit_depth: int) -> None:
    """Fill `out` [bytes] with `frame` [h, w] of `bit_depth` significant bits, scaled to the format's depth."""
    layout = LAYOUTS[pixel_format]
    dn = frame.reshape(-1)
    if layout.depth > bit_depth:
        dn = dn << np.uint16(layout.depth - bit_depth)
    elif layout.depth < bit_depth:
        dn = dn >> np.uint16(bit_depth - layout.depth)
    if layout.packing == "bytes":
        flat = out if layout.depth == 8 else out.view("<u2")
        flat[: len(dn)] = dn
    elif layout.packing == "packed":
        out[0::3], out[2::3] = dn[0::2] >> 4, dn[1::2] >> 4
        out[1::3] = (dn[0::2] & 15) | (dn[1::2] & 15) << 4
    elif layout.depth == 12:
        out[0::3], out[2::3] = dn[0::2] & 255, dn[1::2] >> 4
        out[1::3] = dn[0::2] >> 8 | (dn[1::2] & 15) << 4
    else:
        out[0::5], out[4::5] = dn[0::4] & 255, dn[3::4] >> 2
        out[1::5] = dn[0::4] >> 8 | (dn[1::4] & 63) << 2
        out[2::5] = dn[1::4] >> 6 | (dn[2::4] & 15) << 4
        out[3::5] = dn[2::4] >> 4 | (dn[3::4] & 3) << 6

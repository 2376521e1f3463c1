"""Two 12-bit pixels in three bytes, in both common orders.

=====  ========  ==================  =======
order  byte 0    byte 1              byte 2
=====  ========  ==================  =======
lsb    a[7:0]    b[3:0] and a[11:8]  b[11:4]
msb    a[11:4]   a[3:0] and b[11:8]  b[7:0]
=====  ========  ==================  =======

(The middle byte's high half is named first.) `lsb` is the order of GenICam's `Mono12p` and `BayerGB12p` (PFNC:
least significant bit first, no gaps). `msb` is the order of TIFF and DNG (FillOrder 1). GigE Vision's older
`Mono12Packed` is neither. Rows follow each other without a gap, as TIFF requires for an even width.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

Order = Literal["lsb", "msb"]


def pack12(
    pixels: NDArray[np.uint16], order: Order = "lsb", *, out: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Return the bytes [3 n / 2] of n pixels (any shape, C order, n even) below 4096, in `out` if given.

    Raises ValueError for an odd number of pixels, and for a pixel that has more than 12 bits.
    """
    if pixels.size % 2:
        raise ValueError(f"expected an even number of pixels, found {pixels.size}")
    packed_bytes = np.empty(pixels.size // 2 * 3, np.uint8) if out is None else out
    highest = _pack(np.ascontiguousarray(pixels).reshape(-1), packed_bytes, order == "msb")
    if highest > 0x0FFF:
        raise ValueError(f"expected pixels of 12 bits, found a bit above them in {int(pixels.max())}")
    return packed_bytes


def unpack12(packed_bytes: NDArray[np.uint8], order: Order = "lsb") -> NDArray[np.uint16]:
    """Return the pixels [2 n / 3] of n bytes that `pack12` or a camera made. Raises ValueError unless n is a
    multiple of 3."""
    if packed_bytes.size % 3:
        raise ValueError(f"expected a multiple of 3 bytes, found {packed_bytes.size}")
    pixels = np.empty(packed_bytes.size // 3 * 2, np.uint16)
    _unpack(np.ascontiguousarray(packed_bytes).reshape(-1), pixels, order == "msb")
    return pixels


@kernel
def _pack(pixels, packed_bytes, msb_first):  # type: ignore[no-untyped-def]
    """Pack the pixels; return the bitwise or of all of them."""
    all_bits = np.uint16(0)
    for pair in range(len(packed_bytes) // 3):
        a, b = pixels[2 * pair], pixels[2 * pair + 1]
        all_bits |= a | b
        if msb_first:
            packed_bytes[3 * pair] = a >> 4
            packed_bytes[3 * pair + 1] = (a & 0xF) << 4 | b >> 8
            packed_bytes[3 * pair + 2] = b & 0xFF
        else:
            packed_bytes[3 * pair] = a & 0xFF
            packed_bytes[3 * pair + 1] = (b & 0xF) << 4 | a >> 8
            packed_bytes[3 * pair + 2] = b >> 4
    return all_bits


@kernel
def _unpack(packed_bytes, pixels, msb_first):  # type: ignore[no-untyped-def]
    for pair in range(len(packed_bytes) // 3):
        first, middle, last = (
            np.uint16(packed_bytes[3 * pair]),
            np.uint16(packed_bytes[3 * pair + 1]),
            np.uint16(packed_bytes[3 * pair + 2]),
        )
        if msb_first:
            pixels[2 * pair] = first << 4 | middle >> 4
            pixels[2 * pair + 1] = (middle & 0xF) << 8 | last
        else:
            pixels[2 * pair] = (middle & 0xF) << 8 | first
            pixels[2 * pair + 1] = last << 4 | middle >> 4

"""KTX 2.0 files (Khronos Texture): a container of a texture with its mip levels, as graphics cards take them.

The layout is that of the Khronos KTX file format specification 2.0 (document revision 4): identifier, header,
index of levels, data format descriptor (Khronos Data Format 1.3), pairs of key and value, and the levels, the
smallest first. Levels are compressed with Zstandard.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.atlas.mip_levels import Codes

_IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
_ZSTANDARD, _ZSTANDARD_LEVEL = 2, 5
_LINEAR, _SRGB, _BT709 = 1, 2, 1
_UP_TO_DATE = 2
"""Version of the basic descriptor block: Khronos Data Format 1.3."""
_PARTITIONS = 16
"""Number of BC7's 64 partitions that are tried. Compared with none, this takes four times as long and halves the
squared error.
"""


@dataclass(frozen=True)
class _Layout:
    """The values that describe a format in the file's header and descriptor."""

    vulkan: int
    """VkFormat"""
    model: int
    transfer: int
    side: int
    """Texels along a side of a block."""
    samples: tuple[tuple[int, int, int, int], ...]
    """First bit, bits, channel and greatest value of each sample of a block."""

    @property
    def block_bytes(self) -> int:
        return sum(bits for _, bits, _, _ in self.samples) // 8


_OF_BC7 = ((0, 128, 0, 2**32 - 1),)


class TexelFormat(Enum):
    """Formats of texels in these files."""

    RGBA8 = _Layout(37, 1, _LINEAR, 1, ((0, 8, 0, 255), (8, 8, 1, 255), (16, 8, 2, 255), (24, 8, 15, 255)))
    """VK_FORMAT_R8G8B8A8_UNORM: nothing is lost."""
    BC5 = _Layout(141, 132, _LINEAR, 4, ((0, 64, 0, 2**32 - 1), (64, 64, 1, 2**32 - 1)))
    """VK_FORMAT_BC5_UNORM_BLOCK: red and green apart from each other, 8 bits a texel."""
    BC7_SRGB = _Layout(146, 134, _SRGB, 4, _OF_BC7)
    """VK_FORMAT_BC7_SRGB_BLOCK: colours, 8 bits a texel."""


def encode_ktx2(levels: Sequence[Codes], texel_format: TexelFormat, notes: Mapping[str, str]) -> bytes:
    """A file of levels [h, w, 3], the largest first, each half as large as the one before (rounded down); BC5
    takes their first two channels. `notes` are its keys and values. Raises ImportError without the packages etcpak
    and zstandard."""
    import zstandard

    layout = texel_format.value
    height, width = levels[0].shape[:2]
    compressor = zstandard.ZstdCompressor(level=_ZSTANDARD_LEVEL)
    descriptor, pairs = _descriptor(layout), _pairs(notes)
    first_level = len(_IDENTIFIER) + 9 * 4 + 4 * 4 + 2 * 8 + 24 * len(levels)
    place = first_level + len(descriptor) + len(pairs)
    index, level_bytes = [b""] * len(levels), []
    for n in range(len(levels) - 1, -1, -1):
        blocks = _blocks(levels[n], texel_format)
        level_bytes.append(compressor.compress(blocks))
        index[n] = struct.pack("<3Q", place, len(level_bytes[-1]), len(blocks))
        place += len(level_bytes[-1])
    header = struct.pack("<9I", layout.vulkan, 1, width, height, 0, 0, 1, len(levels), _ZSTANDARD)
    header += struct.pack("<4I2Q", first_level, len(descriptor), first_level + len(descriptor), len(pairs), 0, 0)
    return b"".join([_IDENTIFIER, header, *index, descriptor, pairs, *level_bytes])


def _descriptor(layout: _Layout) -> bytes:
    size = 24 + 16 * len(layout.samples)
    side = layout.side - 1
    block = struct.pack("<IHH4B", 0, _UP_TO_DATE, size, layout.model, _BT709, layout.transfer, 0)
    block += struct.pack("<4B8B", side, side, 0, 0, layout.block_bytes, *[0] * 7)
    for first_bit, bits, channel, most in layout.samples:
        block += struct.pack("<HBB4x2I", first_bit, bits - 1, channel, 0, most)
    return struct.pack("<I", len(block) + 4) + block


def _pairs(notes: Mapping[str, str]) -> bytes:
    """Keys and values in the order of the keys, each padded to four bytes."""
    pairs_bytes = b""
    for key in sorted(notes):
        pair = key.encode() + b"\0" + notes[key].encode() + b"\0"
        pairs_bytes += struct.pack("<I", len(pair)) + pair + bytes(-len(pair) % 4)
    return pairs_bytes


def _blocks(codes: Codes, texel_format: TexelFormat) -> bytes:
    side = texel_format.value.side
    height, width = codes.shape[:2]
    whole = np.pad(codes, ((0, -height % side), (0, -width % side), (0, 0)), mode="edge")
    texels = np.concatenate([whole, np.full((*whole.shape[:2], 1), 255, np.uint8)], axis=2)
    if texel_format is TexelFormat.RGBA8:
        return texels.tobytes()
    return _compressed_blocks(texels, texel_format)


def _compressed_blocks(texels: NDArray[np.uint8], texel_format: TexelFormat) -> bytes:
    import etcpak

    height, width = texels.shape[:2]
    if texel_format is TexelFormat.BC5:
        return etcpak.compress_bc5(texels.tobytes(), width, height)
    params = etcpak.BC7CompressBlockParams()
    params.init_linear_weights()
    params.m_max_partitions = _PARTITIONS
    return etcpak.compress_bc7(texels.tobytes(), width, height, params)

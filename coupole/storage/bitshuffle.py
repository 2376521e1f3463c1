"""Compresses a frame in tiles, in the format of HDF5's bitshuffle filter (32008), but on any thread.

HDF5 compresses one chunk at a time under one lock. So the tiles are compressed here, by the functions of the
filter that comes with hdf5plugin (ctypes releases the interpreter's lock), and are written directly into the file.
"""

from __future__ import annotations

import ctypes
import functools
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, StorageError

FILL_DN = 65535
"""Value of pixels that are not stored; it does not occur in 12-bit frames."""
BLOCK_PIXELS = 16384
"""Number of pixels that are shuffled together. With the filter's own 4096, zstd takes twice the time and saves
nothing."""
_PIXEL_BYTES = 2


@dataclass(frozen=True)
class Codec:
    """Method for the compression of tiles."""

    name: Literal["lz4", "zstd"]
    level: int | None

    @property
    def filter(self) -> Any:
        """The filter, as h5py's `create_dataset` takes it."""
        import hdf5plugin

        if self.level is None:
            return hdf5plugin.Bitshuffle(nelems=BLOCK_PIXELS, cname=self.name)
        return hdf5plugin.Bitshuffle(nelems=BLOCK_PIXELS, cname=self.name, clevel=self.level)


CODECS = {"lz4": Codec("lz4", None), "zstd": Codec("zstd", 1)}


def codec_of(name: str) -> Codec:
    """Return the codec of this name. Raises InputError if there is none."""
    if name not in CODECS:
        raise InputError(f"--codec: expected one of {', '.join(CODECS)}; found {name}")
    return CODECS[name]


def tile_shape(height_px: int, width_px: int) -> tuple[int, int]:
    """Return rows and columns of a tile. It has at most 256 x 512 pixels. All tiles have one size, with the least
    excess beyond the frame's edges.

    This was measured on frames of 4096 x 3072, from the disk. A window of 256 x 256 through all frames is read
    four times faster than from tiles as wide as the frame (twice as fast if it lies across edges). A whole frame
    is read equally fast.
    """

    def share(size_px: int, most_px: int) -> int:
        return -(-size_px // -(-size_px // most_px))

    return share(height_px, 256), share(width_px, 512)


def compressed_tiles(
    pixels: NDArray[np.uint16], tile: tuple[int, int], codec: Codec
) -> Iterator[tuple[tuple[int, int], bytes]]:
    """Yield each tile of a frame [H, W]: row and column of its corner, and its bytes in the file."""
    rows, columns = tile
    block = np.full(tile, FILL_DN, np.dtype("<u2"))
    out = np.empty(12 + _bound(block.size, codec), np.uint8)
    for row in range(0, pixels.shape[0], rows):
        for column in range(0, pixels.shape[1], columns):
            part = pixels[row : row + rows, column : column + columns]
            if part.shape != tile:
                block[:] = FILL_DN
            block[: part.shape[0], : part.shape[1]] = part
            yield (row, column), _compress(block, out, codec)


def _compress(block: NDArray[np.uint16], out: NDArray[np.uint8], codec: Codec) -> bytes:
    """Compress into the filter's format: bytes uncompressed (u64), bytes of a block (u32), both big-endian, then
    the blocks."""
    struct.pack_into(">QI", out.data, 0, block.nbytes, BLOCK_PIXELS * _PIXEL_BYTES)
    to, level = out.ctypes.data + 12, () if codec.level is None else (codec.level,)
    count = getattr(_library(), f"bshuf_compress_{codec.name}")(
        block.ctypes.data, to, block.size, _PIXEL_BYTES, BLOCK_PIXELS, *level
    )
    if count < 0:
        raise StorageError(
            f"bitshuffle: error {count} while compressing a tile. Check the memory of this machine."
        )
    return out[: 12 + count].tobytes()


def _bound(pixels: int, codec: Codec) -> int:
    """Largest possible size of a compressed tile, bytes."""
    return int(getattr(_library(), f"bshuf_compress_{codec.name}_bound")(pixels, _PIXEL_BYTES, BLOCK_PIXELS))


@functools.cache
def _library() -> ctypes.CDLL:
    """hdf5plugin's filter, with the signatures of bitshuffle.h."""
    import hdf5plugin

    library = ctypes.CDLL(str(Path(hdf5plugin.PLUGIN_PATH) / "libh5bshuf.so"))
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    for name, codec in CODECS.items():
        level = [] if codec.level is None else [ctypes.c_int]
        compress, bound = (
            getattr(library, f"bshuf_compress_{name}"),
            getattr(library, f"bshuf_compress_{name}_bound"),
        )
        compress.argtypes, compress.restype = [pointer, pointer, size, size, size, *level], ctypes.c_int64
        bound.argtypes, bound.restype = [size, size, size], size
    return library

"""Decodes a RAW file with LibRaw (`rawpy`): the sensor's pixels without processing, pattern and levels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from drivers.camera.raw.exif import Exif, read_exif

_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
_EVEN_BLACK = 1e-3
"""Black levels of the four Bayer cells count as equal if they differ by at most this share of the white level."""


@dataclass(frozen=True)
class RawPicture:
    """One picture of a still camera."""

    pixels: NDArray[np.uint16]
    """[height_px, width_px], DN, without the sensor's masked margins."""
    frame_format: FrameFormat
    exif: Exif


def read_picture(path: Path, black_dn: int | None = None) -> RawPicture:
    """Decode a file; `black_dn` replaces the black level in the file.

    Raises ValueError for a file that is truncated, has no capture time or is not of a Bayer sensor; OSError.
    """
    exif = read_exif(path)
    pixels, frame_format = decode(path, black_dn)
    return RawPicture(pixels, frame_format, exif)


def decode(path: Path, black_dn: int | None = None) -> tuple[NDArray[np.uint16], FrameFormat]:
    """Pixels and format of a file, as in `RawPicture`. Raises ValueError; OSError."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            if (
                raw.raw_type is not rawpy.RawType.Flat
                or raw.raw_pattern is None
                or raw.raw_pattern.shape != (2, 2)
            ):
                raise ValueError("its sensor has no 2 x 2 Bayer pattern")
            letters = raw.color_desc.decode()
            pattern = "".join(letters[colour] for colour in raw.raw_colors_visible[:2, :2].reshape(-1))
            levels, white_dn = list(raw.black_level_per_channel), int(raw.white_level)
            pixels = np.array(raw.raw_image_visible, np.uint16)
    except rawpy.LibRawError as error:
        raise ValueError(f"LibRaw says: {error}") from error
    if pattern not in _PATTERNS:
        raise ValueError(f"its sensor has the colours {pattern}")
    frame_format = FrameFormat(
        height_px=pixels.shape[0],
        width_px=pixels.shape[1],
        bit_depth=white_dn.bit_length(),
        bayer_pattern=pattern,
        black_dn=_black_dn(levels, white_dn) if black_dn is None else black_dn,
        white_dn=white_dn,
    )
    return pixels, frame_format


def _black_dn(levels: list[int], white_dn: int) -> int:
    """Return one black level for the four cells. Raises ValueError if they differ too much."""
    if max(levels) - min(levels) > _EVEN_BLACK * white_dn:
        raise ValueError(f"its cells have different black levels, {levels}: give `black_dn` in the rig")
    return round(sum(levels) / len(levels))

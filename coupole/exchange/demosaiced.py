"""Demosaicing: pictures of a Bayer sensor with all colours in each pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PATTERNS = ("RGGB", "GRBG", "BGGR", "GBRG")
"""Letters of the first two pixels of the first two rows."""


def demosaiced(mosaic: NDArray[np.uint16], pattern: str) -> NDArray[np.uint16]:
    """[h, w, 3] red, green, blue of a picture [h, w], interpolated between the filter's pixels; for MONO, three
    equal channels."""
    if pattern == "MONO":
        return np.repeat(mosaic[..., None], 3, axis=2)
    import cv2

    return np.asarray(cv2.demosaicing(mosaic, getattr(cv2, f"COLOR_Bayer{pattern}2RGB")), np.uint16)

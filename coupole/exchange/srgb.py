"""sRGB's transfer curve (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def srgb(linear: NDArray[Any]) -> NDArray[Any]:
    """Encoded values, 0 to 1, of linear ones; what is outside is cut off."""
    clipped = np.clip(linear, 0.0, 1.0)
    encoded: NDArray[Any] = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    found: NDArray[Any] = encoded.astype(linear.dtype)
    return found

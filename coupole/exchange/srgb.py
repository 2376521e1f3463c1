"""sRGB's transfer curve (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def srgb(linear: NDArray[Any]) -> NDArray[Any]:
    """Encoded values, 0 to 1, of linear ones; values outside are clipped."""
    inside = np.clip(linear, 0.0, 1.0)
    codes: NDArray[Any] = np.where(inside <= 0.0031308, 12.92 * inside, 1.055 * inside ** (1 / 2.4) - 0.055)
    result: NDArray[Any] = codes.astype(linear.dtype)
    return result


def linear_from_srgb(codes: NDArray[Any]) -> NDArray[Any]:
    """Linear values, 0 to 1, of encoded ones."""
    linear: NDArray[Any] = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    return linear

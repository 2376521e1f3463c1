"""Colours of pictures and pages. Red is used only for refusals and collisions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.pages.palettes import colours_of

Colour = tuple[float, float, float]
"""Red, green and blue from 0 to 1."""

RED: Colour = (0.86, 0.08, 0.10)
HOME: Colour = (0.93, 0.62, 0.25)
ARM: Colour = (0.42, 0.58, 0.78)
TOOL: Colour = (0.16, 0.30, 0.50)
SUPPORT: Colour = (0.90, 0.91, 0.92)
OBJECT: Colour = (0.83, 0.78, 0.68)
KEEP_OUT: Colour = (0.55, 0.40, 0.62)
CAMERA_WAY: Colour = (0.05, 0.45, 0.42)
FLANGE_WAY: Colour = (0.62, 0.66, 0.70)
SIGHT: Colour = (0.10, 0.25, 0.50)
UNUSED: Colour = (0.80, 0.80, 0.80)
INK: Colour = (0.13, 0.15, 0.18)


def of_share(share: ArrayLike) -> NDArray[np.float64]:
    """Return colours [..., 3] of shares [...] from 0 to 1, which are the colours of amounts on all pages."""
    return colours_of(share)


def css(colour: ArrayLike) -> str:
    """Return `rgb(12,34,56)`."""
    red, green, blue = (round(255 * float(part)) for part in np.asarray(colour, np.float64))
    return f"rgb({red},{green},{blue})"

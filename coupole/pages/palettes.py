"""Colours of values, from dark to light, or to both sides of a middle. They have no red, and are readable in
grey."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

LEVELS = 200
"""Number of colours of a palette, all different. So a page reads a value from its pixel's colour to 1 in 199 of
the range."""

ANCHORS = {
    "amount": ((0.16, 0.16, 0.32), (0.20, 0.42, 0.55), (0.35, 0.68, 0.55), (0.95, 0.85, 0.30)),
    "signed": ((0.13, 0.33, 0.62), (0.93, 0.93, 0.91), (0.70, 0.35, 0.05)),
    "grey": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}
"""Red, green and blue from 0 to 1, evenly spaced over the range. All eyes can distinguish blue and orange."""


def colours_of(share: ArrayLike, palette: str = "amount") -> NDArray[np.float64]:
    """Return colours [..., 3] of shares [...] from 0 to 1."""
    anchors = np.array(ANCHORS[palette])
    at = np.clip(np.asarray(share, np.float64), 0, 1) * (len(anchors) - 1)
    return np.stack([np.interp(at, np.arange(len(anchors)), column) for column in anchors.T], axis=-1)


@cache
def table(palette: str) -> NDArray[np.uint8]:
    """Return the colours [LEVELS, 3]."""
    return np.asarray(np.rint(255 * colours_of(np.linspace(0, 1, LEVELS), palette)), np.uint8)


def hexadecimal(palette: str) -> list[str]:
    """Return the table's colours, six letters each."""
    return [bytes(colour).hex() for colour in table(palette)]


def gradient(palette: str) -> str:
    """Return the palette as a CSS gradient from left to right."""
    stops = ",".join(f"#{bytes(np.rint(255 * np.array(colour)).astype(np.uint8)).hex()}"
                     for colour in ANCHORS[palette])  # fmt: skip
    return f"linear-gradient(to right,{stops})"

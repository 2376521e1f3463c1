"""Samples as ALTA's text, from its layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

MOST_LOST = 1e-4


def values(path: Path) -> np.ndarray:
    """The column f."""
    return np.loadtxt(path, ndmin=2)[:, 3]

"""Samples as JSON of the BiRD project, from its layout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

MOST_LOST = 1e-4


def values(path: Path) -> np.ndarray:
    """The values of the BRDF."""
    return np.array(json.loads(path.read_text())["data"]["BRDF"]["values"])

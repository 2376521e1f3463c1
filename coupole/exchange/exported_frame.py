"""One frame as input of every format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Picture:
    """One proven frame with its metadata."""

    pixels: NDArray[np.uint16]
    """[H, W] DN, as the camera gave them."""
    pattern: str
    """2x2 Bayer pattern from the top left, or MONO."""
    black_dn: int
    white_dn: int
    exposure_us: int
    taken_utc: str
    """Time when the frame was proven, soon after it was taken, UTC, ISO 8601; empty if not known."""
    about: dict[str, Any]
    """Stored in the file as JSON: shot, LED, exposure, pose, lens, `simulated`, run."""

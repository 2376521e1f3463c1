"""Pairs of frames of one scene, light and exposure, from which the response of a sensor is determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

BLOCK = 64
"""Number of neighbouring pixels in which the scene is assumed to be a smooth curve."""


@dataclass(frozen=True)
class Pair:
    """Two frames of one scene, light and exposure. Their values are [pixels], DN above the dark frame, of one
    channel."""

    name: str
    exposure_us: float
    first: Floats
    second: Floats
    saturation_mask: NDArray[np.bool_]
    """[pixels] True where at least one of the frames is saturated."""


@dataclass(frozen=True)
class Estimate:
    """A figure and its standard uncertainty."""

    value: float
    u: float


def refuse_all_clipped(pairs: Sequence[Pair]) -> None:
    bright = [pair for pair in pairs if pair.saturation_mask.mean() > 0.5]
    if len(bright) > len(pairs) - 4:
        raise InputError(
            f"response: more than half of the pixels are saturated in {pair_names(bright)}; expected four "
            "exposures or more without saturation. Add shorter ones"
        )


def pair_names(pairs: Sequence[Pair]) -> str:
    names = [pair.name for pair in pairs]
    return ", ".join(names[:4]) + (" and others" if len(names) > 4 else "")

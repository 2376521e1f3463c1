"""Chooses the most informative pictures among pictures under known lights; only chosen pictures are read.

The choice is the same as with `lights: {kind: adaptive}` in a run (`coupole.preflight.next_lights`). It serves
domes that take pictures in another way, and shows for old pictures how many would have been enough.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.preflight.next_lights import FEWEST_TAKEN, NextLights, next_lights, spread_lights
from coupole.reflectance.picture_set import PictureSet

Floats = NDArray[np.float64]

_SITES = 4096
"""Approximate number of pixels that are used to rate lights."""


@dataclass(frozen=True)
class HowMany:
    """Number of lights to be chosen, and the size of the steps."""

    most: int
    """Greatest number of lights that are chosen."""
    relit_rms: float | None = None
    """Expected error at which the choice ends, as a share of the pictures' bright level."""
    first: int = FEWEST_TAKEN
    """Number of lights at the start, spread over the dome."""
    at_a_time: int = 1
    """Number of lights that are chosen before their pictures are read."""


def choose_pictures(
    pictures: PictureSet, how_many: HowMany, *, say: Callable[[int, int], None] = lambda done, of: None
) -> dict[str, Any]:
    """Return the numbers of the chosen lights in their order, and the expected error of each step; all are JSON
    values.

    Raises InputError for fewer or more lights than can be chosen, or for a picture that cannot be read.
    """
    _refuse(pictures, how_many)
    every = np.arange(len(pictures))
    chosen_lights = spread_lights(pictures.directions, every, how_many.first)
    values = np.empty((0, 0))
    steps: list[dict[str, Any]] = []
    while True:
        values = _with_new(pictures, values, chosen_lights, say, how_many.most)
        count = min(how_many.at_a_time, how_many.most - len(chosen_lights))
        following = next_lights(values, pictures.directions, chosen_lights, every, count)
        steps.append(_step(len(chosen_lights), following))
        is_enough = how_many.relit_rms is not None and steps[-1]["relit_rms"] <= how_many.relit_rms
        if is_enough or not len(following.lights):
            break
        chosen_lights = np.append(chosen_lights, following.lights)
    return {
        "chosen": chosen_lights.tolist(),
        "pictures": [pictures.files[light].name for light in chosen_lights],
        "of": len(pictures),
        "relit_rms": steps[-1]["relit_rms"],
        "stopped_by": "relit_rms" if is_enough else "count",
        "steps": steps,
        "left_out": np.setdiff1d(every, chosen_lights).tolist(),
    }


def _refuse(pictures: PictureSet, how_many: HowMany) -> None:
    if not FEWEST_TAKEN <= how_many.first <= how_many.most:
        raise InputError(
            f"--first: expected {FEWEST_TAKEN} lights or more, and no more than --count {how_many.most}; "
            f"got {how_many.first}"
        )
    if how_many.most > len(pictures):
        raise InputError(
            f"--count: expected at most the {len(pictures)} lights of the pictures, got {how_many.most}"
        )


def _with_new(
    pictures: PictureSet,
    values: Floats,
    chosen_lights: NDArray[np.int64],
    say: Callable[[int, int], None],
    most: int,
) -> Floats:
    """[chosen, sites] grey values, in full scales; `values` has the grey values of the lights that were chosen
    before."""
    rows = list(values)
    step = max(1, pictures.pixels // _SITES)
    for light in chosen_lights[len(rows) :].tolist():
        say(len(rows), most)
        picture = pictures.raw_values(light)[::step] / pictures.full_scale / pictures.intensities[light]
        rows.append(picture.mean(axis=1))
    return np.stack(rows)


def _step(count: int, following: NextLights) -> dict[str, Any]:
    return {
        "lights": count,
        "relit_rms": float(f"{following.expected_rms:.4g}"),
        "next": following.lights.tolist(),
        "next_best": list(following.alternatives),
    }

"""Light from all directions for a page: as many directions as the page averages, with a density proportional to
the light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.look.look_blocks import Look
from coupole.reflectance.new_light.environment import read_environment

SAMPLES = 64
"""Number of directions that a page averages."""


def with_environment(look: Look, path: Path | None, axes: NDArray[np.float64]) -> Look:
    """Return the contents with the light of a file. `axes` [3, 3] are the directions of its middle, its left and
    up. Raises the InputError of `read_environment`."""
    if path is None:
        return look
    ways, radiances, density = read_environment(path, axes, np.ones(3)).sample(SAMPLES)
    # shuffled, so that the first few represent all
    order = np.argsort(np.arange(SAMPLES) * 0.6180339887498949 % 1.0)
    irradiances = SAMPLES * radiances / density[:, None]
    about = {"name": path.name, "ways": ways[order].tolist(), "irradiances": irradiances[order].tolist()}
    facts = look.about["told"] | {"Surroundings": f"{path.name}, {SAMPLES} directions of it"}
    return replace(look, about=look.about | {"environment": about, "told": facts})

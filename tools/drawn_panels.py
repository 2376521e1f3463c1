"""Random cells for the flat field: views of a panel, reduced to blocks, with one effect that a fit may not model.

The effects are those of `prove_flat_field`. No code of the processing computes the light here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.flat_field import FlatView

Floats = NDArray[np.float64]
SIZE_PX, FOCAL_PX, BLOCK_PX, DISTANCE_MM = (1024, 768), 1350.0, 32, 335.0
OWN, NOISE = 1.25e-3, 5e-4
"""Relative scatter of the blocks' responses, and noise of a block in one view."""
_SHIFTS = ((0, 0, 0), (60, 0, 60), (-60, 0, -60), (0, 60, 90), (0, -60, -90), (60, 60, 30), (-60, -60, -30))
"""Places of the views of the plan `flat-field`: x and y in mm, roll in degrees."""


@dataclass(frozen=True)
class DrawnField:
    """A random cell: what a calibration knows, and the truth."""

    views: tuple[FlatView, ...]
    falloff: Callable[[Floats], Floats]
    """True fall-off [...] at pixels [..., 2]."""


def draw_field(seed: int, cause: str, strength: float) -> DrawnField:
    """Return a cell with one effect of this strength. For one seed, all else is the same."""
    random, random_of_cause = np.random.default_rng((seed, 1)), np.random.default_rng((seed, 2))
    middle = (np.array(SIZE_PX) - 1.0) / 2.0
    centre = middle + random.normal(0.0, 8.0, 2)
    bends, evenness = random.uniform(-0.2, 0.2, 2), random.uniform(-0.04, 0.04, 5)
    turn, directions, phases = (random_of_cause.uniform(0.0, 2 * np.pi, n) for n in (1, 3, 3))
    waves_per_mm = random_of_cause.uniform(0.02, 0.05, 3)

    def falloff(pixels: Floats) -> Floats:
        away_px = np.linalg.norm(pixels - centre, axis=-1)
        far = away_px / np.hypot(*SIZE_PX) * 2.0
        value = np.cos(np.arctan(away_px / FOCAL_PX)) ** 4 * np.exp(bends[0] * far**2 + bends[1] * far**4)
        x, y = np.moveaxis((pixels - middle) / middle[0], -1, 0)
        if cause == "oval":
            value = value * np.exp(strength * ((x**2 - y**2) * np.cos(turn) + 2.0 * x * y * np.sin(turn)))
        if cause == "slant":
            value = value * np.exp(strength * (x**3 - x * y))
        return np.asarray(value)

    def shine(places_mm: Floats, away_mm: Floats) -> Floats:
        x, y = places_mm.T / 100.0
        log = np.column_stack([x, y, x * x, x * y, y * y]) @ evenness
        if cause == "panel":
            along = places_mm @ np.stack([np.cos(directions), np.sin(directions)])
            log = log + strength * np.sin(along * waves_per_mm + phases).sum(axis=1)
        if cause == "beam":
            log = log + strength * np.log(np.cos(np.arctan(np.linalg.norm(away_mm, axis=1) / DISTANCE_MM)))
        return np.asarray(np.exp(log))

    columns, rows = (np.arange(BLOCK_PX // 2, side, BLOCK_PX) - 0.5 for side in SIZE_PX)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    away_mm = (pixels - middle) * DISTANCE_MM / FOCAL_PX
    own = 1.0 + OWN * random.standard_normal(len(pixels))
    views = []
    for number, (dx, dy, roll_deg) in enumerate(_SHIFTS):
        c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
        places_mm = away_mm @ np.array([[c, s], [-s, c]]) + (dx, dy)
        light = 1000.0 * (1.0 + 0.1 * number) * falloff(pixels) * shine(places_mm, away_mm) * own
        noisy = light * (1.0 + NOISE * random.standard_normal(len(pixels)))
        views.append(FlatView(f"f{number}", pixels, noisy, places_mm))
    return DrawnField(tuple(views), falloff)

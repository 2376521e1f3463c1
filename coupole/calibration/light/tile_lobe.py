"""A lobe of a white tile beside Minnaert's law, by Ward's model (ACM SIGGRAPH 1992).

It has several widths, alone and with a part that grows towards grazing light. The certificate includes the lobe:
the matt part does not reflect the light that the lobe reflects.
"""

from __future__ import annotations

import numpy as np

from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import Angles
from coupole.calibration.rotations import Floats

WIDTHS = (0.15, 0.25, 0.4, 0.6, 0.9, 1.4)
"""Root mean square slopes of the lobes."""
ALBEDO = 0.01
"""Strength of a lobe with a coefficient of 1: its reflectance for light along the normal."""
_GRID = 64
"""Number of steps of the angle in the integral of a lobe's reflectance."""


def lobes_of(angles: Angles, tile: Tile) -> Floats:
    """Return [..., modes] relative change of the signal by lobes that reflect `ALBEDO` of light along the
    normal, for a tile whose certificate counts them."""
    raw = _ward(angles)
    albedo = _ward_albedo()
    unit = ALBEDO / np.tile(albedo[: len(WIDTHS)], 2)
    matt = tile.brdf(angles.incidence, angles.observation)[..., None]
    if tile.geometry == "0/45":
        forty_five = _geometry(np.array([1.0]), np.array([np.sqrt(0.5)]))
        certified_change = _ward(forty_five)[0] / tile.brdf(forty_five.incidence, forty_five.observation)[0]
    else:
        certified_change = albedo / tile.reflectance
    return np.asarray((raw / matt - certified_change) * unit)


def _geometry(incidence: Floats, observation: Floats) -> Angles:
    """Return the angles of light in the plane of the view, on its other side."""
    difference = 0.5 * (np.arccos(incidence) + np.arccos(observation))
    half = np.cos(difference - np.arccos(incidence))
    return Angles(incidence, observation, half, np.cos(difference))


def _ward(angles: Angles) -> Floats:
    """Return [..., modes] 1/sr of Ward's lobes, then the same times (1 - h.l)^3."""
    cosines = np.maximum(angles.incidence * angles.observation, 1e-6)
    tangent2 = 1.0 / np.maximum(angles.half, 1e-3) ** 2 - 1.0
    lobes = np.stack([np.exp(-tangent2 / m**2) / (4.0 * np.pi * m**2 * np.sqrt(cosines)) for m in WIDTHS], axis=-1)
    return np.concatenate([lobes, lobes * ((1.0 - angles.difference) ** 3)[..., None]], axis=-1)


def _ward_albedo() -> Floats:
    """Return [modes] reflectance of the lobes for light along the normal."""
    observation = (np.arange(_GRID) + 0.5) / _GRID
    lobes = _ward(_geometry(np.ones(_GRID), observation))
    return np.asarray(2.0 * np.pi * np.mean(lobes * observation[:, None], axis=0))

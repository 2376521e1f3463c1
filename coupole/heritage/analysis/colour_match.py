"""Colour difference of two reflectances under several lights: CIEDE2000, and the special index of metamerism."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError


@dataclass(frozen=True, eq=False)
class Match:
    """Colours and difference of the pair under one light."""

    light: str
    delta_e00: float
    metamerism: float
    """The remaining difference under this light, after the pair is made equal under the first light; 0 for the
    first light."""
    target_xyz: Array
    recipe_xyz: Array
    white_xyz: Array


def matches(
    target: Array, recipe: Array, lights: Sequence[str], observer: light.Observer = "10 deg"
) -> tuple[Match, ...]:
    """Compare reflectances [81], as measured in air, under each light. Ends that are NaN take the nearest known
    value.

    The special index (CIE 15:2004, 9.2.2.3) corrects the recipe's XYZ by the ratios that make it equal to the
    target under the first light. CIEDE2000 is computed by colour-science. Raises InputError for an unknown light.
    """
    functions = light.observer(observer)
    a, b = (_fill_missing(values) for values in (target, recipe))
    light_matches: list[Match] = []
    ratio = np.ones(3)
    for number, name in enumerate(lights):
        power = _power(name)
        xyz_a, xyz_b, white = (light.tristimulus(r, power, functions) for r in (a, b, np.ones(len(a))))
        if number == 0:
            ratio = xyz_a / xyz_b
        residual = difference(xyz_a, xyz_b * ratio, white) if number else 0.0
        light_matches.append(Match(name, difference(xyz_a, xyz_b, white), residual, xyz_a, xyz_b, white))
    return tuple(light_matches)


def difference(xyz_a: Array, xyz_b: Array, white: Array) -> float:
    """CIEDE2000 of two colours under a white."""
    import colour

    return float(colour.difference.delta_E_CIE2000(light.lab(xyz_a, white), light.lab(xyz_b, white)))


def _fill_missing(values: Array) -> Array:
    is_known = np.isfinite(values)
    return np.interp(np.arange(len(values)), np.flatnonzero(is_known), values[is_known])


def _power(name: str) -> Array:
    try:
        return light.illuminant(name)
    except InputError:
        return light.led(name)

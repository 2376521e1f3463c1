"""Directions of light from pictures of a matte body; each LED is judged by the pictures of all others.

On a matte object that does not move, a pixel's value under a far light is `l . b`. Here l is the direction of the
light times its illuminance, and b is the pixel's normal times its reflectance (Woodham, "Photometric method for
determining surface orientation from multiple images", Opt. Eng. 19, 1980). All pictures together give b from the
table's directions. Each picture then gives a direction, which is compared with the table's. The shape of the
object need not be known.

An LED must not confirm itself, so its direction comes from normals that were found without it. These normals need
no new solution: removing one light from a least-squares solution is a change of rank one (`Normals.without`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

MOST_DEVIATION_DEG = 25.0
"""Greatest angle between the direction in a picture and the table's. Shadows, gloss and the nearness of the LEDs
change the direction in a picture. `coupole calibrate leds` finds LEDs that are swapped within this angle."""
FEWEST_LEDS = 8
_LIT_SHARE = 0.1
_RIDGE = 1e-6
_FEWEST_LIGHTS = 4
"""A pixel that fewer lights reach gives no normal."""
_LEAST_REST = 1e-4
"""Least share of a direction that must be left when a light is taken out. If less is left, the pixel is solved
again, because the update would lose more than four digits."""
_ROUNDS = 4
Floats = NDArray[np.float64]
Each = Callable[[str, Iterable[int]], Iterable[int]]
"""Function that goes through numbers. It may show the progress, and may end by an exception."""


def deviations_deg(
    pictures: Floats, lights: Floats, iterate: Each = lambda _, numbers: numbers
) -> tuple[Floats, float]:
    """Return angles [leds] between the directions that pictures [leds, pixels] show and `lights` [leds, 3]. The
    second value says how well the object shows directions: the smallest over the largest singular value of its
    normals.

    Each LED's direction comes from normals that the other pictures give. Pictures of LEDs that are found to be
    elsewhere are left out.
    """
    lights = lights / np.linalg.norm(lights, axis=1).mean()
    lit = pictures > _LIT_SHARE * np.maximum(pictures.max(axis=0), 1e-9)
    good = np.ones(len(lights), bool)
    angles_deg = np.zeros(len(lights))
    for turn in range(_ROUNDS):
        normals = Normals(pictures, lights, lit, good)
        for led in iterate(f"directions, round {turn + 1} of at most {_ROUNDS}", range(len(lights))):
            angles_deg[led] = _angle_deg(_direction(pictures[led], normals.without(led), lit[led]), lights[led])
        # The worst only: one wrong LED bends the normals by which its neighbours are judged.
        worst = np.where(good, angles_deg, 0.0).argmax()
        if angles_deg[worst] <= MOST_DEVIATION_DEG or good.sum() <= FEWEST_LEDS:
            break
        good = good & (angles_deg < max(MOST_DEVIATION_DEG, 0.7 * angles_deg[worst]))
    singular_values = np.linalg.svd(Normals(pictures, lights, lit, good).from_all_lights(), compute_uv=False)
    return angles_deg, float(singular_values[-1] / max(singular_values[0], 1e-12))


class Normals:
    """Normals times reflectance [3, pixels]. For each pixel it is the least-squares solution of `lights . b =
    picture` over the `good` lights that reach the pixel. Pixels that fewer than four lights reach count as
    black."""

    def __init__(self, pictures: Floats, lights: Floats, lit: NDArray[np.bool_], good: NDArray[np.bool_]) -> None:
        self._pictures, self._lights, self._used = pictures, lights, lit & good[:, None]
        self._counts = self._used.sum(axis=0)
        weights = self._used.astype(np.float64)
        products = np.einsum("li,lj->lij", lights, lights).reshape(-1, 9)
        self._inverses = np.linalg.inv((weights.T @ products).reshape(-1, 3, 3) + _RIDGE * np.eye(3))
        sides = (weights * pictures).T @ lights
        self._solved = np.einsum("pij,pj->ip", self._inverses, sides)

    def from_all_lights(self) -> Floats:
        """Return the normals from all good lights."""
        return np.where(self._counts < _FEWEST_LIGHTS, 0.0, self._solved)

    def without(self, led: int) -> Floats:
        """Return the normals from all good lights but one.

        Let b be the solution of all lights, N their inverse normal matrix, y the pixel's value under the light l,
        u = N l and h = l . u. Then the solution without l is b - u (y - l . b) / (1 - h) (Sherman and Morrison,
        Ann. Math. Stat. 21, 1950; Cook and Weisberg, Residuals and Influence in Regression, 1982, eq. 2.2.8).
        """
        light = self._lights[led]
        normals = self._solved.copy()
        at = np.flatnonzero(self._used[led])
        gains = self._inverses[at] @ light
        rest = 1.0 - gains @ light
        residual = self._pictures[led, at] - light @ self._solved[:, at]
        well = rest > _LEAST_REST
        normals[:, at[well]] -= (gains[well] * (residual[well] / rest[well])[:, None]).T
        counts = self._counts - self._used[led]
        for pixel in at[~well & (counts[at] >= _FEWEST_LIGHTS)]:
            normals[:, pixel] = self._anew(int(pixel), led)
        return np.where(counts < _FEWEST_LIGHTS, 0.0, normals)

    def _anew(self, pixel: int, led: int) -> Floats:
        led_mask = self._used[:, pixel].copy()
        led_mask[led] = False
        lights = self._lights[led_mask]
        normal: Floats = np.linalg.solve(
            lights.T @ lights + _RIDGE * np.eye(3), lights.T @ self._pictures[led_mask, pixel]
        )
        return normal


def _direction(picture: Floats, normals: Floats, lit: NDArray[np.bool_]) -> Floats:
    return np.asarray(np.linalg.lstsq(normals[:, lit].T, picture[lit], rcond=None)[0], dtype=np.float64)


def _angle_deg(a: Floats, b: Floats) -> float:
    cosine = float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

"""Values of a point under a light between the measured lights: a weighted sum of the measured values.

Radial basis functions of the lights' directions with a linear tail (Lucat et al. 2025, 5.2): the weights of the
measured lights depend on directions alone, so one solution serves all pixels. The best kernel depends on the
object and is found by leaving lights out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

KERNELS = ("linear", "thin plate", "power 1.5", "cubic", "root")
"""phi(r) of the distance r between unit vectors: -r, r2 log r, -r^1.5, r3, -sqrt(r)."""
_DIGITS = 9
TAIL = 4
"""Number of unknowns of the linear tail."""


def _phi(r: Floats, kernel: str) -> Floats:
    match kernel:
        case "linear":
            return -r
        case "thin plate":
            return r * r * np.log(np.maximum(r, 1e-300))
        case "power 1.5":
            return -(r**1.5)
        case "cubic":
            return r**3
        case "root":
            return -np.sqrt(r)
    raise ValueError(kernel)


def weights(light_directions: Floats, new_directions: Floats, kernel: str) -> Floats:
    """[wanted, measured] weights of the values under lights in `light_directions` [n, 3], for lights in
    `new_directions` [m, 3]."""
    count = len(light_directions)
    tail: Floats = np.hstack([np.ones((count, 1)), light_directions])
    system = np.zeros((count + TAIL, count + TAIL))
    system[:count, :count] = _phi(_distances(light_directions, light_directions), kernel)
    system[:count, count:], system[count:, :count] = tail, tail.T
    right: Floats = np.hstack(
        [
            _phi(_distances(new_directions, light_directions), kernel),
            np.ones((len(new_directions), 1)),
            new_directions,
        ]
    )
    # lights in one plane leave part of the tail open: the least solution is taken
    solution = np.linalg.lstsq(system.T, right.T, rcond=1e-12)[0]
    return np.asarray(solution.T[:, :count], dtype=np.float64)


def _distances(a: Floats, b: Floats) -> Floats:
    distances: Floats = np.linalg.norm(a[:, None] - b[None], axis=2)
    return distances


def nearest(light_directions: Floats, direction: Floats, count: int) -> NDArray[np.int64]:
    """Return the indices of the measured lights nearest to a direction, the nearest first. Lights at equal
    distances, as in rings of lamps, keep the order of the table, whatever the rounding."""
    return np.argsort(_distances(direction[None], light_directions)[0].round(_DIGITS), kind="stable")[:count]


def left_without(light_directions: Floats, number: int, neighbours: int) -> NDArray[np.int64]:
    """Return the indices of the lights that remain when one light and some of its nearest neighbours are
    removed."""
    near_lights = nearest(light_directions, light_directions[number], neighbours + 1)
    return np.setdiff1d(np.arange(len(light_directions)), np.append(near_lights, number))

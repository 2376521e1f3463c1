"""A coarse mesh in place of a fine one, for the first picture of a page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_TRIANGLES = 20_000
_FINER = 1.25
"""Factor by which the number of cells on a side grows at each trial."""


@dataclass(frozen=True)
class CoarseMesh:
    """All places in one cell of a grid become one (Rossignac and Borrel, Multi-resolution 3D approximations for
    rendering complex scenes, 1993). Triangles that lose their area are removed."""

    places: NDArray[np.uint16]
    """[m, 3]"""
    triangles: NDArray[np.uint32]
    """[n, 3] numbers of the places."""
    stands_for: NDArray[np.int64]
    """[n] for each triangle, one triangle of the fine mesh from which it came."""


def coarse_mesh(
    places: NDArray[np.uint16], triangles: NDArray[np.uint32], most: int = MOST_TRIANGLES
) -> CoarseMesh:
    """Make a coarse mesh from places [m, 3] in steps of a grid and triangles [n, 3]. It is the finest of the
    trials with at most `most` triangles."""
    cells = 4.0
    trial = _clustered_mesh(places, triangles, cells)
    while len(trial.triangles) <= most and cells < 1 << 16:
        last_fit, cells = trial, cells * _FINER
        trial = _clustered_mesh(places, triangles, cells)
    return last_fit if len(trial.triangles) > most else trial


def _clustered_mesh(places: NDArray[np.uint16], triangles: NDArray[np.uint32], cells: float) -> CoarseMesh:
    x, y, z = (places / (65536.0 / cells)).astype(np.uint64).T
    _, cluster, members = np.unique(
        x << np.uint64(40) | y << np.uint64(20) | z, return_inverse=True, return_counts=True
    )
    means = np.stack([np.bincount(cluster, places[:, k], len(members)) / members for k in range(3)], axis=1)
    new = cluster[triangles]
    whole = ((new[:, 0] != new[:, 1]) & (new[:, 1] != new[:, 2]) & (new[:, 2] != new[:, 0])).nonzero()[0]
    first = _first_of_each(np.sort(new[whole], axis=1))
    return CoarseMesh(np.rint(means).astype(np.uint16), new[whole[first]].astype(np.uint32), whole[first])


def _first_of_each(rows: NDArray[Any]) -> NDArray[np.int64]:
    """[n] numbers of the rows of [m, 3] small numbers that did not occur before."""
    number = rows.astype(np.uint64)
    if len(number) and number.max() >= 1 << 21:
        return np.arange(len(rows))
    keys = number[:, 0] << np.uint64(42) | number[:, 1] << np.uint64(21) | number[:, 2]
    first: NDArray[np.int64] = np.unique(keys, return_index=True)[1]
    return first

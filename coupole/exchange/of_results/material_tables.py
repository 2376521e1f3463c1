"""Single materials of a result, and the reflectance of their GGX for any pair of directions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.kernels import kernel
from coupole.reflectance.cluster_file import CLUSTERS
from coupole.reflectance.ggx import lobe

_MOST = 64
"""Greatest number of files that are written without being named."""


@dataclass(frozen=True)
class Material:
    """Material of one triangle, or of a cluster of triangles."""

    name: str
    kd: Floats
    """[3] 1/sr"""
    ks: Floats
    alpha: float

    def reflectance(self, ways_in: Floats, ways_out: Floats) -> Floats:
        """[n, 3] f, 1/sr, for unit directions [n, 3] to the light and to the viewer, z the normal; 0 from
        below."""
        values = np.zeros(len(ways_in))
        _lobes(np.ascontiguousarray(ways_in), np.ascontiguousarray(ways_out), self.alpha, values)
        above = (ways_in[:, 2] > 0.0) & (ways_out[:, 2] > 0.0)
        f: Floats = np.where(above[:, None], self.kd + values[:, None] * self.ks, 0.0)
        return f


def materials_of(surface: MeasuredSurface) -> Iterator[Material]:
    """Return the materials of the chosen triangles or, by default, those of all clusters.

    Raises InputError if a triangle has no material, or if no triangle is chosen and there are no clusters, or too
    many.
    """
    chosen_triangles(surface, optional=True)
    for number in surface.options.triangles:
        yield Material(f"triangle{number}", surface.kd[number], surface.ks[number], float(surface.alpha[number]))
    if surface.options.triangles:
        return
    folder = surface.result.folder
    how = "name triangles with --triangle"
    if not (folder / CLUSTERS).exists():
        raise InputError(f"{folder}: has no clusters; {how}, or find some: `coupole reflectance cluster {folder}`")
    clusters = surface.result.clusters
    if len(clusters.alpha) > _MOST:
        raise InputError(
            f"{folder}: has {len(clusters.alpha)} clusters, a file each; {how}, or make {_MOST} at most"
        )
    for number in range(len(clusters.alpha)):
        kd, ks = (np.broadcast_to(values[number], 3) for values in (clusters.kd, clusters.ks))
        yield Material(f"cluster{number}", kd, ks, float(clusters.alpha[number]))


def chosen_triangles(surface: MeasuredSurface, *, optional: bool = False) -> NDArray[np.int64]:
    """Return the chosen triangles. Raises InputError if a triangle does not exist or has no material, or if no
    triangle is named."""
    if not surface.options.triangles and not optional:
        raise InputError("--triangle: expected the numbers of triangles whose samples are exported")
    for number in surface.options.triangles:
        if number >= len(surface.triangles):
            raise InputError(f"--triangle {number}: the mesh has {len(surface.triangles)}, counted from 0")
        if not surface.has_material[number]:
            raise InputError(f"--triangle {number}: has no material; no view, or too few lights, have seen it")
    return np.array(surface.options.triangles, np.int64)


@kernel
def _lobes(ways_in, ways_out, alpha, values):  # type: ignore[no-untyped-def]
    for n in range(len(values)):
        nl, nv = ways_in[n, 2], ways_out[n, 2]
        if nl > 0.0 and nv > 0.0:
            half = ways_in[n] + ways_out[n]
            values[n] = lobe(nl, nv, half[2] / np.sqrt(np.sum(half * half)), alpha)[0]

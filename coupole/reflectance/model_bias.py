"""Common tilt of all fitted normals of a material, which is subtracted from them.

A material that does not have the fit's form makes the fitted normals lean, towards the cameras or away from them.
This tilt cannot be estimated from single triangles, and their residuals do not show it. But errors of the
scanner's vertices are independent of the tilt, and of each other at distances of some millimetres. So over many
triangles the mean difference between fitted and scanned normals is the fit's error. It changes slowly with the
direction in which the surface faces: it is modelled as a polynomial of second degree of that direction, for
triangles that look alike. The remainder is noise, which the covariance of the fit states.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.reflectance.clustering import clusters_of, looks
from coupole.reflectance.least_squares import one_thread
from coupole.reflectance.triangle_fit import TriangleMaterials, prior_stiffness

Floats = NDArray[np.float64]

FEWEST = 90
"""Least number of triangles of a material: ten for each coefficient."""
_TOGETHER, _MOST_GROUPS = 1000, 8
"""Least number of triangles that share a polynomial, and largest number of polynomials."""
_NEAREST = 50
"""Number of triangles whose mean normal is taken as the direction in which the surface faces."""
_USUAL_TILT = np.radians(3.0)
"""Usual tilt of fitted normals, rad. This tilt limits the weight of large triangles, whose normals the scanner
measures well."""
_CHUNK = 1 << 16


def unbiased_normals(
    materials: TriangleMaterials, mesh_normals: Floats, centres_mm: Floats, areas_mm2: Floats, noise_um: float
) -> Floats:
    """[n, 3] fitted normals without their common deviation from the mesh's normals [n, 3]; unchanged for too few
    triangles. `noise_um` is the noise of the mesh's vertices.
    """
    normals = materials.normals.copy()
    fitted_triangles = np.flatnonzero(np.isfinite(materials.alpha))
    if len(fitted_triangles) < FEWEST:
        return normals
    with one_thread():
        faces = _facing(mesh_normals[fitted_triangles], centres_mm[fitted_triangles], areas_mm2[fitted_triangles])
        group = clusters_of(
            looks(materials.at(fitted_triangles)),
            int(np.clip(len(fitted_triangles) // _TOGETHER, 1, _MOST_GROUPS)),
        )
        spread2 = 2.0 / prior_stiffness(areas_mm2[fitted_triangles], noise_um) + _USUAL_TILT**2
        off = normals[fitted_triangles] - mesh_normals[fitted_triangles]
        lean = np.zeros_like(off)
        for number in np.unique(group):
            in_group = group == number
            if np.count_nonzero(in_group) >= FEWEST:
                lean[in_group] = _smooth(faces[in_group], off[in_group], 1.0 / spread2[in_group])
    lean -= np.sum(lean * normals[fitted_triangles], axis=1, keepdims=True) * normals[fitted_triangles]
    normals[fitted_triangles] = _unit(normals[fitted_triangles] - lean)
    return normals


def _facing(normals: Floats, centres_mm: Floats, areas_mm2: Floats) -> Floats:
    """[n, 3] mean normals of the nearest triangles. With the normal of a single triangle, the scanner's noise
    would change the direction of the polynomial, and would so be taken as the fit's error."""
    tree, mean_normals = cKDTree(centres_mm), np.empty_like(normals)
    for first in range(0, len(normals), _CHUNK):
        part = slice(first, first + _CHUNK)
        near = tree.query(centres_mm[part], k=min(_NEAREST, len(normals)))[1]
        mean_normals[part] = np.einsum("nk,nki->ni", areas_mm2[near], normals[near])
    return _unit(mean_normals)


def _smooth(faces: Floats, off: Floats, weights: Floats) -> Floats:
    """[n, 3] polynomial of second degree in directions [n, 3], fitted to `off` [n, 3] by weighted least
    squares."""
    x, y, z = faces.T
    terms = np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y, 3.0 * z * z - 1.0], axis=1)
    root = np.sqrt(weights / weights.mean())[:, None]
    polynomial: Floats = terms @ np.linalg.lstsq(root * terms, root * off, rcond=None)[0]
    return polynomial


def _unit(vectors: Floats) -> Floats:
    unit_vectors: Floats = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit_vectors

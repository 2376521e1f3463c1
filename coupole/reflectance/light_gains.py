"""Brightness of each picture relative to all pictures together: it shows wrong intensities, different exposures,
faulty files.

A picture's gain is the median over pixels of its value, divided by the value of the fitted materials. The fit is
robust, so a few faulty pictures among many do not change it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.ggx import lobe
from coupole.reflectance.light_interpolation import nearest
from coupole.reflectance.normal_fit import PointMaterials

SUSPECT = 0.05
"""Least difference of a gain from 1 that is reported."""
_LIT = 0.2
"""Least cosine of incidence at pixels that are used."""
GAIN_NEIGHBOURS = 3
"""Number of nearest pictures whose median gain a new picture gets."""


def gains(
    grey: NDArray[np.float64], materials: PointMaterials, lights: NDArray[np.float64], view: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[lights] gain of each picture, from values [pixels, lights] under lights in `directions` [lights, 3]."""
    pixels = np.flatnonzero(np.isfinite(materials.kd))
    half = lights + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    model = modelled_values(
        materials.normals[pixels],
        materials.kd[pixels],
        materials.ks[pixels],
        materials.alpha[pixels],
        lights,
        half,
        view,
    )
    lit = materials.normals[pixels] @ lights.T > _LIT
    ratio = np.where(lit, grey[pixels] / np.maximum(model, 1e-12), np.nan)
    light_gains = np.ones(len(lights))
    enough = np.count_nonzero(lit, axis=0) > 0
    light_gains[enough] = np.nanmedian(ratio[:, enough], axis=0)
    return light_gains


def gain_between(
    light_directions: NDArray[np.float64], gains_of_lights: NDArray[np.float64], direction: NDArray[np.float64]
) -> float:
    """Return the gain that a picture with another light direction would have had. It is the median of the nearest
    pictures, so that one faulty picture among good ones has no effect."""
    return float(np.median(gains_of_lights[nearest(light_directions, direction, GAIN_NEIGHBOURS)]))


@kernel
def modelled_values(normals, kd, ks, alpha, lights, half, view):  # type: ignore[no-untyped-def]
    """[pixels, lights] values of materials under lights; 0 where a light or the view is behind the surface."""
    values = np.zeros((len(normals), len(lights)))
    for pixel in range(len(normals)):
        n0, n1, n2 = normals[pixel]
        nv = n0 * view[0] + n1 * view[1] + n2 * view[2]
        for light in range(len(lights)):
            nl = n0 * lights[light, 0] + n1 * lights[light, 1] + n2 * lights[light, 2]
            if nl > 0.0 and nv > 0.0:
                nh = n0 * half[light, 0] + n1 * half[light, 1] + n2 * half[light, 2]
                values[pixel, light] = nl * (kd[pixel] + ks[pixel] * lobe(nl, nv, nh, alpha[pixel])[0])
    return values

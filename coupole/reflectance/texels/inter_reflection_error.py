"""Covariance of texels' normals and materials from the inter-reflection that was subtracted from their samples.

The light from other surfaces is estimated with a relative uncertainty. Residuals of a fit do not show its error.
Three parts are propagated through the normal equations of the fit, triangle by triangle:

- What was subtracted is wrong by one factor under all LEDs. It is largest under LEDs that the other surface faces,
  so the fitted normal turns to it.
- The estimate is made between patches that are larger than a triangle. So a triangle may get more or less than was
  estimated, by a part of what triangles of the view get on average, under all LEDs alike;
- and by the same part under each group of neighbouring LEDs, because they light the same side of what is around.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.extraction.sample_codes import REACHED
from coupole.reflectance.ggx import UNKNOWNS, root_by_unknowns, tangents
from coupole.reflectance.normal_fit import CAUCHY
from coupole.reflectance.run_result import INTER_REFLECTION, ViewSamples, u_inter_reflection
from coupole.reflectance.texels.pixel_fit import LEAST_COSINE, LOG_ALPHA, LOG_KS, TILT, Lights, Prior, add_product
from coupole.reflectance.triangle_fit import between, towards

Floats = NDArray[np.float64]

_ROWS = 1 << 12
"""Number of triangles whose inter-reflection is read together."""


def covariance_of_inter_reflection(view: ViewSamples, materials: Prior, lights: Lights) -> Floats:
    """[triangles, 5, 5] covariance of tilts and logarithms of kd, ks and alpha, for the triangles of a view with
    `materials` (NaN: none), fitted to some `lights`. 0 if nothing was subtracted."""
    covariance = np.zeros((len(view.triangles), UNKNOWNS, UNKNOWNS))
    with h5py.File(view.path, "r") as file:
        if INTER_REFLECTION not in file:
            return covariance
        parts = list(_parts(file, view, materials, lights))
        sums, counts = np.zeros(len(lights.columns)), np.zeros(len(lights.columns))
        for part in parts:
            _add_parts_of_kd(part.u_samples(), *part.places, *part.of_triangles, sums, counts)
        u_around = sums / np.maximum(counts, 1.0)
        for part in parts:
            _propagate(
                part.u_samples(), u_around, lights.group, *part.places, *part.of_triangles, covariance[part.rows]
            )
    return covariance


@dataclass(frozen=True)
class _Part:
    """Triangles whose inter-reflection is read together."""

    rows: slice
    places: tuple[Floats, Floats, Floats]
    """Centres of the triangles [n, 3], LEDs [leds, 3] and camera [3], mm."""
    of_triangles: tuple[Floats, ...]
    """Normals [n, 3], kd, ks and alpha [n]."""
    _file: h5py.File
    _columns: NDArray[np.integer]

    def u_samples(self) -> NDArray[np.float32]:
        """[n, leds] standard uncertainty of the samples, as a part of them; NaN without a sample."""
        u = u_inter_reflection(self._file[INTER_REFLECTION][self.rows][:, self._columns]).mean(axis=2)
        u[self._file["codes"][self.rows][:, self._columns] != REACHED] = np.nan
        return np.asarray(u, np.float32)


def _parts(file: h5py.File, view: ViewSamples, materials: Prior, lights: Lights) -> Iterator[_Part]:
    for first in range(0, len(view.triangles), _ROWS):
        rows = slice(first, first + _ROWS)
        places = file["centres_mm"][rows], lights.places_mm, lights.camera_mm
        of_triangles = materials.normals[rows], materials.kd[rows], materials.ks[rows], materials.alpha[rows]
        yield _Part(rows, places, of_triangles, file, lights.columns)


@kernel(error_model="numpy")
def _add_parts_of_kd(  # type: ignore[no-untyped-def]
    u_samples, centres_mm, led_mm, camera_mm, normals, kd, ks, alpha, sums, counts
):
    """Add the uncertainties of the triangles' values under each LED, as parts of kd, to `sums` [leds]."""
    rows, roots = np.empty((len(led_mm), UNKNOWNS)), np.empty(len(led_mm))
    for n in range(len(u_samples)):
        _look(u_samples[n], centres_mm[n], led_mm, camera_mm, normals[n], kd[n], ks[n], alpha[n], roots, rows)
        for led in np.flatnonzero(roots > 0.0):
            sums[led] += u_samples[n, led] * roots[led] * roots[led] / kd[n]
            counts[led] += 1.0


@kernel(error_model="numpy")
def _propagate(  # type: ignore[no-untyped-def]
    u_samples, u_around, group, centres_mm, led_mm, camera_mm, normals, kd, ks, alpha, covariance
):
    leds, groups = len(led_mm), int(group.max()) + 1
    rows, roots = np.empty((leds, UNKNOWNS)), np.empty(leds)
    prior = np.diag(np.array([1.0 / TILT**2, 1.0 / TILT**2, 1e-2, 1.0 / LOG_KS**2, 1.0 / LOG_ALPHA**2]))
    for n in range(len(covariance)):
        _look(u_samples[n], centres_mm[n], led_mm, camera_mm, normals[n], kd[n], ks[n], alpha[n], roots, rows)
        information, scores = prior.copy(), np.zeros((groups + 2, UNKNOWNS))
        per_variance = 1.0 / (CAUCHY * CAUCHY * kd[n])
        for led in np.flatnonzero(roots > 0.0):
            own_factor = per_variance * 0.5 * roots[led] * u_samples[n, led]
            around_factor = per_variance * 0.5 * kd[n] * u_around[led] / roots[led]
            add_product(per_variance, rows[led], rows[led], information)
            for i in range(UNKNOWNS):
                scores[groups, i] += own_factor * rows[led, i]
                scores[groups + 1, i] += around_factor * rows[led, i]
                scores[group[led], i] += around_factor * rows[led, i]
        if np.isfinite(information).all() and np.isfinite(scores).all():
            for number in range(groups + 2):
                step = np.linalg.solve(information, scores[number])
                add_product(1.0, step, step, covariance[n])


@kernel(error_model="numpy")
def _look(u_samples, centre_mm, led_mm, camera_mm, normal, kd, ks, alpha, roots, rows):  # type: ignore[no-untyped-def]
    """Fill the roots of a triangle's values under LEDs, and their derivatives; 0 where it has no sample."""
    light, half, view = np.empty(3), np.empty(3), np.empty(3)
    roots[:] = 0.0
    towards(centre_mm, camera_mm, view)
    nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
    if not (alpha > 0.0 and nv > LEAST_COSINE):
        return
    t1, t2 = tangents(normal[0], normal[1], normal[2])
    v1 = t1[0] * view[0] + t1[1] * view[1] + t1[2] * view[2]
    v2 = t2[0] * view[0] + t2[1] * view[1] + t2[2] * view[2]
    for led in range(len(led_mm)):
        towards(centre_mm, led_mm[led], light)
        between(light, view, half)
        nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
        if u_samples[led] >= 0.0 and nl > 0.0:
            roots[led] = root_by_unknowns(normal, t1, t2, light, half, nv, v1, v2, kd, ks, alpha, rows[led])

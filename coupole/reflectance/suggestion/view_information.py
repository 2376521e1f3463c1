"""Expected information of views about an object's materials, to compare views before anything is measured.

A fit's covariance is H^-1 M H^-1 (`coupole.reflectance.material_uncertainty`). H and M are sums over samples, so
each view adds its own samples. Here the derivatives are computed for a supposed material. M contains the errors
that are known beforehand: the frames' noise, each LED's own power, and the priors. The uncertainty stated with a
plan comes from `rehearsal`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.ggx import UNKNOWNS, root_by_unknowns, tangents
from coupole.reflectance.material_uncertainty import LEAST_KNOWN
from coupole.reflectance.normal_fit import CAUCHY, SPREAD_KS
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial
from coupole.reflectance.suggestion.supposed_signal import SeenParts, Surface, reflectances
from coupole.reflectance.triangle_fit import USUAL, between, prior_stiffness, towards

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ViewInformation:
    """Sums over the samples of one view, for the parts that it sees and several numbers of LEDs."""

    parts: NDArray[np.int64]
    """[k] numbers of the parts, in rising order."""
    bread: Floats
    """[numbers, k, 5, 5] derivatives of the scores."""
    meat: Floats
    """[numbers, k, 5, 5] variance of the scores."""


@dataclass
class Information:
    """Sums over the samples of all views so far, for the n parts of a surface."""

    bread: Floats
    """[n, 5, 5] derivatives of the scores."""
    meat: Floats
    """[n, 5, 5] variance of the scores."""

    @staticmethod
    def before(surface: Surface, noise_um: float) -> Information:
        """Return the information before any sample: the mesh's normals, and usual materials."""
        stiffness = prior_stiffness(surface.triangle_areas_mm2, noise_um)
        bread = np.zeros((len(stiffness), UNKNOWNS, UNKNOWNS))
        for place, precision in ((2, LEAST_KNOWN), (3, USUAL / SPREAD_KS**2), (4, USUAL)):
            bread[:, place, place] = precision
        for tilt in range(2):
            bread[:, tilt, tilt] = stiffness
        return Information(bread, bread.copy())

    def gains(self, view: ViewInformation, number: int) -> Floats:
        """[k] half the decrease of the logarithm of the determinant of each part's covariance, by a view with one
        of its numbers of LEDs."""
        bread, meat = self.bread[view.parts], self.meat[view.parts]
        before = _log_determinants(bread, meat)
        return 0.5 * (before - _log_determinants(bread + view.bread[number], meat + view.meat[number]))

    def add(self, view: ViewInformation, number: int) -> None:
        """Add the information of a view with one of its numbers of LEDs."""
        self.bread[view.parts] += view.bread[number]
        self.meat[view.parts] += view.meat[number]


def _log_determinants(bread: Floats, meat: Floats) -> Floats:
    """[k] logarithms of the determinants of the covariances."""
    logarithms: Floats = np.linalg.slogdet(meat)[1] - 2.0 * np.linalg.slogdet(bread)[1]
    return logarithms


def information_of(
    surface: Surface,
    view: SeenParts,
    material: SupposedMaterial,
    exposures_us: Sequence[int],
    led_rows: NDArray[np.int64],
    numbers: Sequence[int],
) -> ViewInformation:
    """Return the information of a view, with the first n of `led_rows` for each n in `numbers`, which are in
    rising order."""
    parts = view.parts
    bread, meat = np.zeros((2, len(numbers), len(parts), UNKNOWNS, UNKNOWNS))
    f = reflectances(surface, view, material, surface.leds_mm, parts)[0]
    signal_dn_per_s = surface.signal_per_f[parts] * f[:, :, None]
    channel_pixels = view.pixels[parts][:, None, None] * surface.noise.channel_share
    by_channel = surface.noise.relative_variances(signal_dn_per_s, channel_pixels, exposures_us)
    channels = by_channel.shape[2]
    variances = by_channel.sum(axis=2) / channels**2 + surface.u_own**2
    variances[~np.isfinite(f)] = np.inf
    _fill(
        surface.points_mm[parts], surface.normals[parts], view.camera_mm, surface.leds_mm, variances,
        (material.kd, material.ks, material.alpha), np.asarray(led_rows, np.int64), np.array(numbers, np.int64),
        bread, meat,
    )  # fmt: skip
    return ViewInformation(parts, bread.cumsum(axis=0), meat.cumsum(axis=0))


@kernel
def _fill(  # type: ignore[no-untyped-def]
    points_mm, normals, camera_mm, leds_mm, variances, material, led_rows, numbers, bread, meat
):
    """Add the samples of the additional LEDs of each number to `bread` and `meat` [numbers, k, 5, 5]. `variances`
    [k, leds] are relative variances of the channels' mean, infinite for no sample."""
    kd, ks, alpha = material
    scale2 = CAUCHY * CAUCHY * kd
    light, view, half, row = np.empty(3), np.empty(3), np.empty(3), np.empty(UNKNOWNS)
    for part in range(len(points_mm)):
        normal = normals[part]
        t1, t2 = tangents(normal[0], normal[1], normal[2])
        towards(points_mm[part], camera_mm, view)
        nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
        v1 = t1[0] * view[0] + t1[1] * view[1] + t1[2] * view[2]
        v2 = t2[0] * view[0] + t2[1] * view[1] + t2[2] * view[2]
        first = 0
        for number in range(len(numbers)):
            for led in led_rows[first : numbers[number]]:
                if not variances[part, led] < np.inf:
                    continue
                towards(points_mm[part], leds_mm[led], light)
                between(light, view, half)
                root = root_by_unknowns(normal, t1, t2, light, half, nv, v1, v2, kd, ks, alpha, row)
                by_noise = 0.25 * root * root * variances[part, led] / scale2
                for i in range(UNKNOWNS):
                    for j in range(UNKNOWNS):
                        product = row[i] * row[j] / scale2
                        bread[number, part, i, j] += product
                        meat[number, part, i, j] += by_noise * product
            first = numbers[number]

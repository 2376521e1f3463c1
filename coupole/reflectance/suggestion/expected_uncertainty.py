"""Uncertainty that a fit of a material will have, before anything is measured.

The fit's covariance is H^-1 M H^-1 (`coupole.reflectance.material_uncertainty`). Both are sums over samples, so
each view adds its own to them. Here the derivatives are those of a supposed material, and M has what is known
beforehand: the frames' noise, each LED's own power, and the priors. It serves to compare views; what a plan
promises is `rehearsal`'s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.ggx import UNKNOWNS, lobe, root_by_unknowns, tangents
from coupole.reflectance.material_uncertainty import LEAST_KNOWN
from coupole.reflectance.normal_fit import CAUCHY, SPREAD_KS
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial
from coupole.reflectance.suggestion.supposed_signal import SeenParts, Surface
from coupole.reflectance.triangle_fit import USUAL, between, prior_stiffness, towards

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Information:
    """Sums of what samples tell of the materials of n parts, for several numbers of LEDs; a sum over views."""

    bread: Floats
    """[numbers, n, 5, 5] the scores' derivatives."""
    meat: Floats
    """[numbers, n, 5, 5] the scores' variance."""
    samples: Floats
    """[numbers, n]"""

    def __add__(self, more: Information) -> Information:
        return Information(self.bread + more.bread, self.meat + more.meat, self.samples + more.samples)

    def at(self, number: int) -> Information:
        """Return the same of one number of LEDs."""
        part = slice(number, number + 1)
        return Information(self.bread[part], self.meat[part], self.samples[part])


def information_of(
    surface: Surface,
    view: SeenParts,
    material: SupposedMaterial,
    exposures_us: Sequence[int],
    led_rows: NDArray[np.int64],
    numbers: Sequence[int],
) -> Information:
    """Return what a view tells, with the first n of `led_rows` for each n of `numbers`, which rise."""
    count = len(surface.points_mm)
    bread, meat = np.zeros((2, len(numbers), count, UNKNOWNS, UNKNOWNS))
    samples = np.zeros((len(numbers), count))
    noise = np.stack([surface.noise.in_dark_dn2, surface.noise.gain_dn, surface.channel_share], axis=1)
    _fill(
        surface.points_mm, surface.normals, view.camera_mm, view.pixels, surface.leds_mm, surface.signal_per_f,
        view.is_lit, surface.u_own, noise, (surface.noise.least_dn, surface.noise.most_dn),
        (material.kd, material.ks, material.alpha), np.array(exposures_us, float) * 1e-6,
        np.asarray(led_rows, np.int64), np.array(numbers, np.int64), bread, meat, samples,
    )  # fmt: skip
    return Information(bread, meat, samples)


def prior_information(surface: Surface, noise_um: float) -> Information:
    """Return what is known of each part before any sample: the mesh's normal, and usual materials."""
    stiffness = prior_stiffness(surface.triangle_areas_mm2, noise_um)
    bread = np.zeros((1, len(stiffness), UNKNOWNS, UNKNOWNS))
    for place, precision in ((2, LEAST_KNOWN), (3, USUAL / SPREAD_KS**2), (4, USUAL)):
        bread[..., place, place] = precision
    for tilt in range(2):
        bread[..., tilt, tilt] = stiffness
    return Information(bread, bread.copy(), np.zeros(bread.shape[:2]))


def covariance_of(information: Information) -> Floats:
    """[numbers, n, 5, 5] of the unknowns of `ggx.UNKNOWNS`, from a sum that has the prior in it."""
    inverse = np.linalg.inv(information.bread)
    covariance: Floats = inverse @ information.meat @ inverse
    return covariance


@numba.njit(cache=True, nogil=True)
def _fill(  # type: ignore[no-untyped-def]
    points_mm, normals, camera_mm, pixels, leds_mm, signal_per_f, is_lit, u_own, noise, range_dn, material,
    times_s,
    led_rows, numbers, bread, meat, samples,
):  # fmt: skip
    kd, ks, alpha = material
    scale2 = CAUCHY * CAUCHY * kd
    light, view, half, row = np.empty(3), np.empty(3), np.empty(3), np.empty(UNKNOWNS)
    for part in range(len(points_mm)):
        if pixels[part] <= 0.0:
            continue
        normal = normals[part]
        t1, t2 = tangents(normal[0], normal[1], normal[2])
        towards(points_mm[part], camera_mm, view)
        nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
        v1 = t1[0] * view[0] + t1[1] * view[1] + t1[2] * view[2]
        v2 = t2[0] * view[0] + t2[1] * view[1] + t2[2] * view[2]
        number = 0
        for place in range(len(led_rows)):
            while number < len(numbers) and numbers[number] <= place:
                number += 1
            if number == len(numbers):
                break
            led = led_rows[place]
            if not is_lit[part, led]:
                continue
            towards(points_mm[part], leds_mm[led], light)
            nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
            if nl <= 0.0:
                continue
            between(light, view, half)
            nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
            f = kd + ks * lobe(nl, nv, nh, alpha)[0]
            u2 = _variance(f, signal_per_f[part, led], pixels[part], noise, range_dn, times_s)
            if not u2 < np.inf:
                continue
            u2 += u_own[led] * u_own[led]
            root = root_by_unknowns(normal, t1, t2, light, half, nv, v1, v2, kd, ks, alpha, row)
            by_noise = 0.25 * root * root * u2 / scale2
            samples[number, part] += 1.0
            for i in range(UNKNOWNS):
                for j in range(UNKNOWNS):
                    product = row[i] * row[j] / scale2
                    bread[number, part, i, j] += product
                    meat[number, part, i, j] += by_noise * product
        for later in range(1, len(numbers)):
            samples[later, part] += samples[later - 1, part]
            bread[later, part] += bread[later - 1, part]
            meat[later, part] += meat[later - 1, part]


@numba.njit(cache=True, nogil=True)
def _variance(f, signal_per_f, pixels, noise, range_dn, times_s):  # type: ignore[no-untyped-def]
    """Relative variance of the channels' mean of a sample by noise; infinite where a channel has no value."""
    total = 0.0
    for channel in range(len(noise)):
        total += relative_variance(f, signal_per_f[channel], pixels, noise[channel], range_dn, times_s)
    return total / (len(noise) * len(noise))


@numba.njit(cache=True, nogil=True)
def relative_variance(f, signal_per_f, pixels, noise, range_dn, times_s):  # type: ignore[no-untyped-def]
    """Relative variance by noise of a channel's sample, from all exposures in which it is neither too dark nor
    saturated; infinite where it is so in all. `noise` is the pixels' variance in the dark, their gain, and the
    channel's share of them."""
    precision = 0.0
    for exposure in range(len(times_s)):
        signal_dn = signal_per_f * f * times_s[exposure]
        if range_dn[0] < signal_dn < range_dn[1]:
            precision += pixels * noise[2] * signal_dn * signal_dn / (noise[0] + noise[1] * signal_dn)
    return 1.0 / precision if precision > 0.0 else np.inf


def signal_quantile(
    surface: Surface, views: Sequence[SeenParts], material: SupposedMaterial, quantile: float
) -> float:
    """Quantile of the samples' signals, DN/s in the most sensitive channel; NaN without any."""
    signals = []
    for view in views:
        f_cosine = np.full(view.is_lit.shape, np.nan)
        _reflectance(
            surface.points_mm, surface.normals, view.camera_mm, view.pixels, surface.leds_mm, view.is_lit,
            (material.kd, material.ks, material.alpha), f_cosine,
        )  # fmt: skip
        values = surface.signal_per_f.max(axis=2) * f_cosine
        signals.append(values[np.isfinite(values)])
    all_signals = np.concatenate(signals) if signals else np.zeros(0)
    return float(np.quantile(all_signals, quantile)) if len(all_signals) else math.nan


@numba.njit(cache=True, nogil=True)
def _reflectance(points_mm, normals, camera_mm, pixels, leds_mm, is_lit, material, f):  # type: ignore[no-untyped-def]
    kd, ks, alpha = material
    light, view, half = np.empty(3), np.empty(3), np.empty(3)
    for part in range(len(points_mm)):
        if pixels[part] <= 0.0:
            continue
        normal = normals[part]
        towards(points_mm[part], camera_mm, view)
        nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
        for led in range(len(leds_mm)):
            if not is_lit[part, led]:
                continue
            towards(points_mm[part], leds_mm[led], light)
            nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
            if nl <= 0.0:
                continue
            between(light, view, half)
            nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
            f[part, led] = kd + ks * lobe(nl, nv, nh, alpha)[0]

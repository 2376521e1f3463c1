"""Draws the samples that a plan would give of a supposed material, and fits them as a result's are.

What is drawn has the frames' noise, each LED's own power and place, and a highlight that grows towards grazing
angles by Schlick's Fresnel term, which the fitted model lacks. The uncertainty is then that of the fit itself,
misfit included. Light from surface to surface, shadows' edges, and errors of poses and mesh are not in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.ggx import lobe
from coupole.reflectance.material_uncertainty import covariances
from coupole.reflectance.suggestion.expected_uncertainty import relative_variance
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial
from coupole.reflectance.suggestion.supposed_signal import SeenParts, Surface
from coupole.reflectance.triangle_fit import TriangleSamples, between, fit_triangles, towards

Floats = NDArray[np.float64]

_MOST_VALUES = 20_000_000
"""Samples that are drawn, of all channels, at most; beyond it fewer parts stand for the surface."""


NORMAL_DEG = "normal_deg"
ExpectedUncertainty = dict[str, Floats]
"""Standard uncertainties [n] of parts by the names that the report of a result has: `normal_deg`, `kd_percent`,
`ks_percent`, `alpha_percent`, kd and ks with what all LEDs share. NaN where too few samples are expected for a
material, and of parts that were not drawn."""


def rehearse(
    surface: Surface,
    views: Sequence[SeenParts],
    material: SupposedMaterial,
    exposures_us: Sequence[int],
    led_rows: NDArray[np.int64],
    noise_um: float,
    *,
    seed: int = 1,
) -> ExpectedUncertainty:
    """The uncertainty of the parts after these views under these LEDs, rows of the dome's table."""
    count, channels = len(surface.points_mm), len(surface.channel_share)
    step = -(-count * len(views) * len(led_rows) * channels // _MOST_VALUES)
    rows = np.arange(0, count, step)
    samples = _drawn_samples(surface, views, material, exposures_us, led_rows, rows, np.random.default_rng(seed))
    mask = np.ones(len(samples.led_mm), np.bool_)
    materials = fit_triangles(samples, mask, noise_um)
    uncertainty = covariances(
        samples, mask, materials, noise_um, fitted_normals=True, middle_mm=surface.points_mm.mean(axis=0)
    )
    variances = np.einsum("nii->ni", uncertainty.covariance).copy()
    variances[:, 2:4] += surface.u_shared**2
    deviations = np.full((count, variances.shape[1]), np.nan)
    deviations[rows] = np.sqrt(variances)
    percents = {f"{name}_percent": 100.0 * deviations[:, 2 + n] for n, name in enumerate(("kd", "ks", "alpha"))}
    return {NORMAL_DEG: np.degrees(np.hypot(deviations[:, 0], deviations[:, 1])), **percents}


def _drawn_samples(
    surface: Surface,
    views: Sequence[SeenParts],
    material: SupposedMaterial,
    exposures_us: Sequence[int],
    led_rows: NDArray[np.int64],
    rows: NDArray[np.int64],
    random: np.random.Generator,
) -> TriangleSamples:
    """Samples of some of the parts; LEDs stand elsewhere, and are as bright otherwise, than the records say."""
    leds_mm, channels = surface.leds_mm[led_rows], len(surface.channel_share)
    true_leds_mm = leds_mm + surface.u_led_mm * random.standard_normal(leds_mm.shape)
    own_power = 1.0 + surface.u_own[led_rows] * random.standard_normal(len(led_rows))
    values = np.full((len(rows), len(views), len(led_rows), channels), np.nan, np.float32)
    noise = np.stack([surface.noise.in_dark_dn2, surface.noise.gain_dn, surface.channel_share], axis=1)
    for number, view in enumerate(views):
        f_cosine, variance = np.full((2, len(rows), len(led_rows), channels), np.nan)
        _fill(
            surface.points_mm[rows], surface.normals[rows], view.camera_mm, view.pixels[rows], leds_mm,
            true_leds_mm,
            surface.signal_per_f[rows][:, led_rows], view.is_lit[rows][:, led_rows], noise,
            (surface.noise.least_dn, surface.noise.most_dn), (material.kd, material.ks, material.alpha),
            np.array(exposures_us, float) * 1e-6, f_cosine, variance,
        )  # fmt: skip
        noisy = 1.0 + np.sqrt(variance) * random.standard_normal(variance.shape)
        values[:, number] = f_cosine * noisy * own_power[None, :, None]
    return TriangleSamples(
        values.reshape(len(rows), -1, channels),
        np.tile(leds_mm, (len(views), 1)),
        np.repeat(np.arange(len(views)), len(led_rows)),
        np.array([view.camera_mm for view in views]),
        surface.points_mm[rows],
        surface.normals[rows],
        surface.triangle_areas_mm2[rows],
    )


@numba.njit(cache=True, nogil=True)
def _fill(  # type: ignore[no-untyped-def]
    points_mm, normals, camera_mm, pixels, leds_mm, true_leds_mm, signal_per_f, is_lit, noise, range_dn, material,
    times_s, f_cosine, variance,
):  # fmt: skip
    """Fill f times the cosine of incidence, [n, leds, channels] in 1/sr, and its noise's relative variance."""
    kd, ks, alpha = material
    light, true_light, view, half = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
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
            towards(points_mm[part], true_leds_mm[led], true_light)
            cosine = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
            nl = normal[0] * true_light[0] + normal[1] * true_light[1] + normal[2] * true_light[2]
            if nl <= 0.0 or cosine <= 0.0:
                continue
            between(true_light, view, half)
            nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
            vh = view[0] * half[0] + view[1] * half[1] + view[2] * half[2]
            fresnel = ks + (1.0 - ks) * (1.0 - vh) ** 5
            f = kd + fresnel * lobe(nl, nv, nh, alpha)[0]
            for channel in range(len(noise)):
                u2 = relative_variance(
                    f, signal_per_f[part, led, channel], pixels[part], noise[channel], range_dn, times_s
                )
                if u2 < np.inf:
                    f_cosine[part, led, channel] = f * nl
                    variance[part, led, channel] = u2

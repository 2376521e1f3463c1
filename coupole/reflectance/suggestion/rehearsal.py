"""Draws the samples that a plan would give for a supposed material, and fits them as in a result.

The samples have the frames' noise, and errors of each LED's power and place. Their highlight grows towards grazing
angles by Schlick's Fresnel term, which the fitted model lacks. So the uncertainty is that of the fit itself,
including the misfit of the model. Inter-reflection, edges of shadows, and errors of poses and mesh are not
included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.material_uncertainty import covariances
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial
from coupole.reflectance.suggestion.supposed_signal import SeenParts, Surface, reflectances
from coupole.reflectance.triangle_fit import TriangleSamples, fit_triangles

Floats = NDArray[np.float64]

_MOST_VALUES = 20_000_000
"""Largest number of drawn samples, of all channels. If there are more, fewer parts represent the surface."""


NORMAL_DEG = "normal_deg"
ExpectedUncertainty = dict[str, Floats]
"""Standard uncertainties [n] of parts, by the names in the report of a result: `normal_deg`, `kd_percent`,
`ks_percent`, `alpha_percent`. Those of kd and ks include the part that all LEDs share. NaN if too few samples are
expected for a material, and for parts that were not drawn."""


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
    """Return the uncertainty of the parts after these views under these LEDs (rows of the dome's table)."""
    count, channels = len(surface.points_mm), surface.signal_per_f.shape[2]
    step = -(-count * len(views) * len(led_rows) * channels // _MOST_VALUES)
    rows = np.arange(0, count, step)
    samples = drawn_samples(surface, views, material, exposures_us, led_rows, rows, np.random.default_rng(seed))
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


def drawn_samples(
    surface: Surface,
    views: Sequence[SeenParts],
    material: SupposedMaterial,
    exposures_us: Sequence[int],
    led_rows: NDArray[np.int64],
    rows: NDArray[np.int64],
    random: np.random.Generator,
) -> TriangleSamples:
    """Return samples of some of the parts. The places and the power of the LEDs have errors against the
    records. Each part has a triangle with whole pixels: where a view gives it no pixel of a channel, it has no
    sample of this channel, and so no material from this view."""
    leds_mm, channels = surface.leds_mm[led_rows], surface.signal_per_f.shape[2]
    true_leds_mm = leds_mm + surface.u_led_mm * random.standard_normal(leds_mm.shape)
    own_power = 1.0 + surface.u_own[led_rows] * random.standard_normal(len(led_rows))
    per_f = surface.signal_per_f[rows][:, led_rows]
    values = np.full((len(rows), len(views), len(led_rows), channels), np.nan, np.float32)
    for number, view in enumerate(views):
        lit_by_these = replace(view, is_lit=view.is_lit[:, led_rows])
        f, cosines = reflectances(surface, lit_by_these, material, true_leds_mm, rows)
        channel_pixels = surface.noise.drawn_pixels(view.pixels[rows], random)
        variances = surface.noise.relative_variances(
            per_f * f[:, :, None], channel_pixels[:, None].astype(np.float64), exposures_us
        )
        variances[~np.isfinite(variances)] = np.nan
        noisy = 1.0 + np.sqrt(variances) * random.standard_normal(variances.shape)
        values[:, number] = (f * cosines * own_power)[:, :, None] * noisy
    return TriangleSamples(
        values.reshape(len(rows), -1, channels),
        np.tile(leds_mm, (len(views), 1)),
        np.repeat(np.arange(len(views)), len(led_rows)),
        np.array([view.camera_mm for view in views]),
        surface.points_mm[rows],
        surface.normals[rows],
        surface.triangle_areas_mm2[rows],
    )

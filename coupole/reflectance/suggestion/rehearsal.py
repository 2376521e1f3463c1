"""Draws the samples that a plan would give for a supposed material, and fits them as in a result.

Triangles of the mesh are drawn. Their samples have the frames' noise, and errors of each LED's power and place.
The pose of each view has the robot's noise, so pixels near a triangle's edge see its neighbour. The highlight
grows towards grazing angles by Schlick's Fresnel term, which the fitted model lacks. So the uncertainty is the
uncertainty of the fit itself, including the misfit of the model. Inter-reflection, edges of shadows, errors of the
mesh, and the width of a pixel are not included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.material_uncertainty import covariances
from coupole.reflectance.suggestion.drawn_triangles import DrawnTriangles, MeshParts
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial
from coupole.reflectance.suggestion.supposed_signal import SeenParts, Surface, seen_samples
from coupole.reflectance.triangle_fit import TriangleSamples, fit_triangles

Floats = NDArray[np.float64]

_MOST_VALUES = 20_000_000
"""Largest number of drawn samples, of all channels. If there are more, fewer triangles are fitted."""
_MOST_DRAWN, _MOST_FITTED = 100_000, 3000
"""Largest number of triangles whose pixels are drawn, and largest number of triangles that are then fitted."""


NORMAL_DEG = "normal_deg"
ExpectedUncertainty = dict[str, Floats]
"""Standard uncertainties [n] of triangles, by the names in the report of a result: `normal_deg`, `kd_percent`,
`ks_percent`, `alpha_percent`. The uncertainties of kd and ks include the part that all LEDs share. NaN for a
triangle with too few samples for a material."""


@dataclass(frozen=True)
class PlannedFrames:
    """Frames of views, each under the same LEDs and with the same exposures."""

    views: Sequence[SeenParts]
    exposures_us: Sequence[int]
    led_rows: NDArray[np.int64]
    """[leds] rows of the dome's table."""


@dataclass(frozen=True)
class Rehearsal:
    """The expected uncertainty for a supposed material."""

    triangles: DrawnTriangles
    """n drawn triangles that the views show in all channels."""
    uncertainty: ExpectedUncertainty
    known_share: float
    """Share of all triangles that get a material."""
    pixels: float
    """Median, over the triangles that views show, of the pixels of a triangle in the view that shows it best."""

    def normal_deg(self) -> float:
        """Median uncertainty of normals; 0 without any."""
        values = self.uncertainty[NORMAL_DEG]
        return float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0


def rehearse(
    surface: Surface,
    mesh: MeshParts,
    frames: PlannedFrames,
    material: SupposedMaterial,
    noise_um: float,
    *,
    seed: int = 1,
) -> Rehearsal:
    """Return the uncertainty of a mesh, with vertices of this uncertainty, from the frames that are frames."""
    views, led_rows = frames.views, frames.led_rows
    random, channels = np.random.default_rng(seed), surface.signal_upright.shape[2]
    triangles = mesh.drawn(_MOST_DRAWN, random)
    mean_pixels = np.stack([triangles.pixels(surface, view) for view in views])
    pixels = np.stack([surface.noise.drawn_pixels(pixels_of_view, random) for pixels_of_view in mean_pixels])
    most_pixels = mean_pixels.max(axis=0)
    shown = np.flatnonzero((pixels > 0).all(axis=2).any(axis=0))
    shown_share = len(shown) / max(len(triangles.numbers), 1)
    most = max(1, min(_MOST_FITTED, _MOST_VALUES // (len(views) * len(led_rows) * channels)))
    if len(shown) > most:
        shown = np.sort(random.choice(shown, most, replace=False))
    triangles, pixels = triangles.only(shown), pixels[:, shown]
    samples = drawn_samples(surface, triangles, pixels, frames, material, random)
    mask = np.ones(len(samples.led_mm), np.bool_)
    materials = fit_triangles(samples, mask, noise_um)
    uncertainty = covariances(
        samples, mask, materials, noise_um, fitted_normals=True, middle_mm=surface.points_mm.mean(axis=0)
    )
    variances = np.einsum("nii->ni", uncertainty.covariance).copy()
    variances[:, 2:4] += surface.u_shared**2
    deviations = np.sqrt(variances)
    percents = {f"{name}_percent": 100.0 * deviations[:, 2 + n] for n, name in enumerate(("kd", "ks", "alpha"))}
    normal_deg = np.degrees(np.hypot(deviations[:, 0], deviations[:, 1]))
    known_share = shown_share * float(np.isfinite(normal_deg).mean()) if len(shown) else 0.0
    is_seen = most_pixels > 0.0
    median_pixels = float(np.median(most_pixels[is_seen])) if is_seen.any() else 0.0
    return Rehearsal(triangles, {NORMAL_DEG: normal_deg, **percents}, known_share, median_pixels)


def drawn_samples(
    surface: Surface,
    triangles: DrawnTriangles,
    pixels: NDArray[np.int64],
    frames: PlannedFrames,
    material: SupposedMaterial,
    random: np.random.Generator,
) -> TriangleSamples:
    """Return samples of the triangles. The places and the power of the LEDs, and the poses of the views, have
    errors against the records. `pixels` [views, n, channels] are the pixels of each triangle; without a pixel of a
    channel, there is no sample of it."""
    views, led_rows = frames.views, frames.led_rows
    leds_mm, channels = surface.leds_mm[led_rows], surface.signal_upright.shape[2]
    true_leds_mm = leds_mm + surface.u_led_mm * random.standard_normal(leds_mm.shape)
    own_power = 1.0 + surface.u_own[led_rows] * random.standard_normal(len(led_rows))
    upright, count = surface.signal_upright[triangles.parts][:, led_rows], len(triangles.parts)
    values = np.full((count, len(views), len(led_rows), channels), np.nan, np.float32)
    for number, (view, channel_pixels) in enumerate(zip(views, pixels, strict=True)):
        shift_mm = surface.u_pose_mm * random.standard_normal((count, 2))
        normals = triangles.seen_normals(view, channel_pixels.sum(axis=1), shift_mm, random)
        is_lit = view.is_lit[triangles.parts][:, led_rows] & _faces(triangles, leds_mm)
        samples = seen_samples(triangles.points_mm, normals, view.camera_mm, true_leds_mm, is_lit, material)
        variances = surface.noise.relative_variances(
            upright * samples[:, :, None], channel_pixels[:, None].astype(np.float64), frames.exposures_us
        )
        variances[~np.isfinite(variances)] = np.nan
        noisy = 1.0 + np.sqrt(variances) * random.standard_normal(variances.shape)
        values[:, number] = (samples * own_power)[:, :, None] * noisy
    return TriangleSamples(
        values.reshape(count, -1, channels),
        np.tile(leds_mm, (len(views), 1)),
        np.repeat(np.arange(len(views)), len(led_rows)),
        np.array([view.camera_mm for view in views]),
        triangles.points_mm,
        triangles.normals,
        triangles.areas_mm2,
    )


def _faces(triangles: DrawnTriangles, leds_mm: Floats) -> NDArray[np.bool_]:
    """[n, leds] Tell whether a triangle faces an LED."""
    heights_mm = triangles.normals @ leds_mm.T - np.sum(triangles.normals * triangles.points_mm, axis=1)[:, None]
    faces: NDArray[np.bool_] = heights_mm > 0.0
    return faces

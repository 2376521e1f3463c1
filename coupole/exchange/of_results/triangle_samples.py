"""The measured samples of one triangle, in its own frame, with bounds."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np

from coupole.errors import InputError
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.reflectance.run_result import ViewSamples
from coupole.reflectance.sample_sources import channel_samples
from coupole.reflectance.sample_uncertainty import bounds


@dataclass(frozen=True)
class SamplesOfTriangle:
    """The n samples of one triangle, from all views and LEDs that gave one."""

    towards_light: Floats
    """[n, 3] unit; z is the mesh's normal, x is the support's x axis, projected onto the triangle."""
    towards_camera: Floats
    """[n, 3]"""
    f: Floats
    """[n, channels] 1/sr; NaN for a channel without a sample."""
    low: Floats
    """[n, channels] lower bound of f."""
    high: Floats
    """[n, channels] upper bound of f; infinite if the light is too grazing for a bound."""


def channels_of(surface: MeasuredSurface) -> tuple[str, ...]:
    """Names of the channels, as in file names."""
    return ("red", "green", "blue") if surface.result.channels == 3 else ("grey",)


def samples_of(surface: MeasuredSurface, triangle: int, quantile: float) -> SamplesOfTriangle:
    """Return the samples with bounds that are `quantile` standard deviations away. Raises InputError if the result
    has no bounds."""
    views = [view for view in surface.result.views if triangle in view.triangles]
    along_x = surface.result.base_from_support[:3, 0]
    scan_noise_um = float(surface.about["scan_noise_um"])
    parts = [_of_view(surface, view, triangle, along_x, scan_noise_um, quantile) for view in views]
    whole = SamplesOfTriangle(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    if np.isnan(np.where(np.isfinite(whole.f), whole.low + whole.high, 0.0)).any():
        raise InputError(
            f"{surface.result.folder}: has no bounds, because it was made without a record of the response, "
            "which states the frames' noise; make it again with such a record (`coupole calibrate response`)"
        )
    return whole


def _of_view(
    surface: MeasuredSurface,
    view: ViewSamples,
    triangle: int,
    along_x: Floats,
    scan_noise_um: float,
    quantile: float,
) -> tuple[Floats, ...]:
    row = int(np.searchsorted(view.triangles, triangle))
    with h5py.File(view.path, "r") as file:
        normal = file["normals"][row].astype(np.float64)
    leds = np.arange(len(view.leds))
    shape = (len(leds), surface.result.channels)
    f, low, high = np.empty(shape), np.empty(shape), np.empty(shape)
    for channel in range(surface.result.channels):
        samples = channel_samples(surface.result, view, np.array([row]), leds, channel, scan_noise_um)
        f[:, channel] = samples.f
        low[:, channel], high[:, channel] = bounds(samples.places, samples.sources, quantile)
    corners = surface.result.corners_mm[triangle].astype(np.float64)
    own_from_base = _frame(normal, along_x)
    ways = [
        _directions(places_mm, corners.mean(axis=0), own_from_base)
        for places_mm in (view.led_mm, np.broadcast_to(view.camera_mm, (len(leds), 3)))
    ]
    return (*ways, f, low, high)


def _frame(normal: Floats, along_x: Floats) -> Floats:
    """[3, 3] rows x, y, z of the triangle's frame. If the normal is along the support's x axis, y takes the place
    of x."""
    x = along_x - (along_x @ normal) * normal
    if np.linalg.norm(x) < 1e-3:
        x = np.cross(normal, np.roll(normal, 1))
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _directions(places_mm: Floats, centre_mm: Floats, own_from_base: Floats) -> Floats:
    ways = (places_mm - centre_mm) @ own_from_base.T
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))

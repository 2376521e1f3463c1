"""The samples of one triangle as they were measured, in its own frame, with bounds."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np

from coupole.errors import InputError
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.reflectance.run_result import INTER_REFLECTION, ViewSamples, u_inter_reflection
from coupole.reflectance.sample_uncertainty import Places, Sources, bounds


@dataclass(frozen=True)
class SamplesOfTriangle:
    """Of all views and LEDs that gave one; n of them."""

    towards_light: Floats
    """[n, 3] unit; z is the mesh's normal, x lies where the support's x axis falls on the triangle."""
    towards_camera: Floats
    """[n, 3]"""
    f: Floats
    """[n, channels] 1/sr; NaN where a channel gave none."""
    low: Floats
    """[n, channels] lower bound over f."""
    high: Floats
    """[n, channels] upper bound over f; infinite where the light grazes too much to tell."""


def channels_of(surface: MeasuredSurface) -> tuple[str, ...]:
    """Names of the channels, as files are named."""
    return ("red", "green", "blue") if surface.result.channels == 3 else ("grey",)


def samples_of(surface: MeasuredSurface, triangle: int, quantile: float) -> SamplesOfTriangle:
    """Bounds are `quantile` standard deviations away. Raises InputError if the result has no bounds."""
    views = [view for view in surface.result.views if triangle in view.triangles]
    along_x = surface.result.base_from_support[:3, 0]
    scan_noise_um = float(surface.about["scan_noise_um"])
    parts = [_of_view(surface, view, triangle, along_x, scan_noise_um, quantile) for view in views]
    whole = SamplesOfTriangle(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    if np.isnan(np.where(np.isfinite(whole.f), whole.low + whole.high, 0.0)).any():
        raise InputError(
            f"{surface.result.folder}: has no bounds, as no record of the response told its frames' noise; make "
            "it anew with one (`coupole calibrate response`)"
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
        f, u_noise = file["f"][row].astype(np.float64), file["u_own"][row].astype(np.float64)
        own, shared, response = file["led_u_own"][()], file["led_u_shared"][()], file["u_response"][row]
        indirect = np.zeros(f.shape)
        if view.inter_reflection is not None:
            indirect = u_inter_reflection(file[INTER_REFLECTION][row])
        led_mm, normal = float(file.attrs["led_u_mm"]), file["normals"][row].astype(np.float64)
    corners = surface.result.corners_mm[triangle].astype(np.float64)
    count, same = len(view.leds), np.ones(len(view.leds))
    places = Places(np.broadcast_to(corners, (count, 3, 3)), view.led_mm, view.led_normals)
    low, high = np.empty(f.shape), np.empty(f.shape)
    for channel in range(f.shape[1]):
        sources = Sources(
            u_noise[:, channel],
            response[channel] * same,
            indirect[:, channel],
            own[:, channel],
            shared[:, channel],
            scan_noise_um * same,
            led_mm * same,
        )
        low[:, channel], high[:, channel] = bounds(places, sources, quantile)
    own_from_base = _frame(normal, along_x)
    ways = [
        _directions(places_mm, corners.mean(axis=0), own_from_base)
        for places_mm in (view.led_mm, np.broadcast_to(view.camera_mm, (count, 3)))
    ]
    return (*ways, f, low, high)


def _frame(normal: Floats, along_x: Floats) -> Floats:
    """[3, 3] rows x, y, z of the triangle's frame; y in place of x where the normal is along the support's x."""
    x = along_x - (along_x @ normal) * normal
    if np.linalg.norm(x) < 1e-3:
        x = np.cross(normal, np.roll(normal, 1))
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _directions(places_mm: Floats, centre_mm: Floats, own_from_base: Floats) -> Floats:
    ways = (places_mm - centre_mm) @ own_from_base.T
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))

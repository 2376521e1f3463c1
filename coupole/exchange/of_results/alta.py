"""Text for ALTA (Belcour, Barla, Pacanowski 2013 on): samples of triangles as they were measured, with bounds.

A file for each channel, as ALTA reads bounds of the first value alone.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from coupole.errors import InputError
from coupole.exchange.of_results.material_tables import chosen_triangles
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.sample_sources import channel_samples
from coupole.reflectance.sample_uncertainty import bounds
from coupole.storage.durable import write_synced

_QUANTILE = 1.959964
"""Of 95 %."""


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`triangleN_red.alta` and so on (`_grey` of a sensor without filter): theta_l, theta_v cos dphi, theta_v sin
    dphi (rad, about the mesh's normal), f (1/sr), its lower and upper bound at 95 %; an open upper bound is the
    largest that float32 can hold."""
    result, paths = surface.result, []
    scan_noise_um = float(surface.about["scan_noise_um"])
    channels = ("red", "green", "blue") if result.channels == 3 else ("grey",)
    for triangle in chosen_triangles(surface):
        parts = [
            _samples(result, view, int(np.searchsorted(view.triangles, triangle)), scan_noise_um)
            for view in result.views
            if triangle in view.triangles
        ]
        for number, channel in enumerate(channels):
            lines = np.concatenate([part[:, number] for part in parts])
            lines = lines[np.isfinite(lines[:, 3])]
            if np.isnan(lines).any():
                raise InputError(
                    f"{result.folder}: has no bounds, as no record of the response told its frames' noise; make "
                    "it anew with one (`coupole calibrate response`)"
                )
            head = [
                f'#SAMPLE "triangle {triangle}, {channel}"',
                f'#ORIGIN "{surface.remark}"',
                "#DIM 3 1",
                "#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI",
                "#PARAM_OUT INV_STERADIAN",
                "#VS 2",
            ]
            text = ["\t".join(f"{value:.7g}" for value in line) for line in lines]
            paths.append(folder / f"triangle{triangle}_{channel}.alta")
            write_synced(paths[-1], "\n".join([*head, *text]) + "\n")
    return paths


def _samples(result: RunResult, view: ViewSamples, row: int, scan_noise_um: float) -> Floats:
    """[leds, channels, 6] the columns of the file, of a triangle in a view; NaN where there is no sample."""
    with h5py.File(view.path, "r") as file:
        normal = file["normals"][row]
    leds = np.arange(len(view.leds))
    lines = np.empty((len(leds), result.channels, 6))
    for channel in range(result.channels):
        mine = channel_samples(result, view, np.array([row]), leds, channel, scan_noise_um)
        low, high = bounds(mine.places, mine.sources, _QUANTILE)
        most = np.finfo(np.float32).max
        lines[:, channel, :3] = _angles(view, mine.places.corners_mm[0].mean(axis=0), normal)
        lines[:, channel, 3:] = np.stack([mine.f, mine.f * low, np.minimum(mine.f * high, most)], axis=1)
    return lines


def _angles(view: ViewSamples, centre_mm: Floats, normal: Floats) -> Floats:
    """[leds, 3] theta_l, theta_v cos dphi, theta_v sin dphi."""

    def polar(places_mm: Floats) -> tuple[Floats, Floats]:
        ways = places_mm - centre_mm
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        cosine = ways @ normal
        return np.arccos(np.clip(cosine, -1.0, 1.0)), ways - cosine[..., None] * normal

    theta_l, along_l = polar(view.led_mm)
    theta_v, along_v = polar(view.camera_mm[None])
    sine = np.cross(along_l, along_v) @ normal
    dphi = np.arctan2(sine, np.sum(along_l * along_v, axis=1))
    return np.stack([theta_l, theta_v * np.cos(dphi), theta_v * np.sin(dphi)], axis=1)

"""Text for ALTA (Belcour, Barla, Pacanowski 2013 on): measured samples of triangles, with bounds.

There is one file for each channel, because ALTA reads bounds of the first value only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.exchange.of_results.material_tables import chosen_triangles
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.exchange.of_results.triangle_samples import SamplesOfTriangle, channels_of, samples_of
from coupole.storage.durable import write_synced

_QUANTILE = 1.959964
"""Quantile of the normal distribution for 95 %."""
_OPEN = float(np.finfo(np.float32).max)


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `triangleN_red.alta` and so on (`_grey` for a sensor without filter).

    The columns are theta_l, theta_v cos dphi, theta_v sin dphi (rad, about the mesh's normal), f (1/sr), its lower
    and its upper bound at 95 %. An unbounded value is the largest number of float32.
    """
    paths = []
    for triangle in chosen_triangles(surface):
        samples = samples_of(surface, int(triangle), _QUANTILE)
        angles = _angles(samples)
        for number, channel in enumerate(channels_of(surface)):
            f = samples.f[:, number]
            with np.errstate(invalid="ignore"):  # 0 if the bound is open
                bounds = f[:, None] * np.stack([samples.low[:, number], samples.high[:, number]], axis=1)
            bounds = np.sort(np.clip(np.nan_to_num(bounds, nan=_OPEN), -_OPEN, _OPEN), axis=1)
            lines = np.column_stack([angles, f, bounds])[np.isfinite(f)]
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


def _angles(samples: SamplesOfTriangle) -> Floats:
    """[n, 3] theta_l, theta_v cos dphi, theta_v sin dphi; dphi is counted from the light's azimuth to the
    camera's."""
    light, camera = samples.towards_light, samples.towards_camera
    theta_l, theta_v = (np.arccos(np.clip(ways[:, 2], -1.0, 1.0)) for ways in (light, camera))
    dphi = np.arctan2(camera[:, 1], camera[:, 0]) - np.arctan2(light[:, 1], light[:, 0])
    return np.stack([theta_l, theta_v * np.cos(dphi), theta_v * np.sin(dphi)], axis=1)

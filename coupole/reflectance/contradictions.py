"""Samples that something in the cell has shaded which nobody described, for example a cable: they are found by
their contradiction.

A cable's full shadow is too dark to give samples. At its edge a triangle is lit in part, and its sample is too low
by any amount. A contradicted sample is darker than the triangle's material in all channels, by more than its noise
allows. The material there is mostly diffuse, so the form of a lobe is not the cause. The neighbouring LEDs agree
with the material, so neither the triangle nor the model is wrong.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.reflectance.discarded_frames import rewrite
from coupole.reflectance.extraction.sample_codes import BY_UNKNOWN
from coupole.reflectance.fits import GGX_NORMAL
from coupole.reflectance.run_result import CONTRADICTED, SAMPLES, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, model_values

Floats = NDArray[np.float64]

BESIDE = 6
"""Number of LEDs beside an LED that it is compared with."""
_FEWEST_BESIDE = 4
"""Least number of these that have a sample."""
_MOST_LEFT = 0.8
"""Share of its light that a sample has kept."""
_AGREE = (0.9, 1.15)
"""Median of the LEDs beside it over the material."""
_LEAST_DIFFUSE = 0.5
"""Least diffuse share of what the material gives."""
_SIGMA = 5.0


@dataclass(frozen=True)
class Neighbours:
    """LEDs beside each LED of a view."""

    places: NDArray[np.int64]
    """[leds, BESIDE]"""

    @classmethod
    def of(cls, led_mm: Floats, middle_mm: Floats) -> Neighbours:
        """Return the LEDs in the directions nearest to each LED's own, as seen from the object's middle."""
        ways = led_mm - middle_mm
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        if len(ways) < 2:
            return cls(np.zeros((len(ways), 0), np.int64))
        return cls(np.asarray(cKDTree(ways).query(ways, k=range(2, min(BESIDE, len(ways) - 1) + 2))[1], np.int64))


def contradiction_mask(
    samples: TriangleSamples, materials: TriangleMaterials, u_noise: NDArray[np.float16], beside: Neighbours
) -> NDArray[np.bool_]:
    """[b, leds] of one view's samples, by materials [b] and relative noise [b, leds, channels]."""
    whole = model_values(samples, materials)
    ways = samples.led_mm - samples.centres_mm[:, None]
    cosine = np.einsum("blk,bk->bl", ways, materials.normals) / np.linalg.norm(ways, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        diffuse = materials.kd[:, None] * np.maximum(cosine, 0.0)[..., None] / whole
        ratio = samples.values / whole
    u_ratio = np.nan_to_num(u_noise.astype(np.float32), nan=np.inf)  # of unknown noise nothing contradicts
    is_finite = np.isfinite(ratio)
    low = is_finite & (ratio < _AGREE[0]) & (ratio + _SIGMA * u_ratio * ratio < 1.0) & (diffuse > _LEAST_DIFFUSE)
    dark: NDArray[np.bool_] = is_finite.any(axis=2) & (low | ~is_finite).all(axis=2)
    if not dark.any():
        return dark
    row, led = np.nonzero(dark)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.nansum(ratio[row], axis=2) / is_finite[row].sum(axis=2)
    neighbour_ratios = np.take_along_axis(mean, beside.places[led], axis=1)
    enough = np.isfinite(neighbour_ratios).sum(axis=1) >= _FEWEST_BESIDE
    middle = np.full(len(neighbour_ratios), np.nan)
    middle[enough] = np.nanmedian(neighbour_ratios[enough], axis=1)
    own_ratio = mean[np.arange(len(led)), led]
    dark[row, led] = (middle > _AGREE[0]) & (middle < _AGREE[1]) & (own_ratio < _MOST_LEFT * middle)
    return dark


@dataclass(frozen=True)
class Found:
    """Samples that contradict others, among those of some rows of a view's file."""

    rows: slice
    places: NDArray[np.int64]
    """[2, n] rows, from the first on, and LEDs."""
    values: int
    """Number of values that these samples have."""
    all_values: int
    """Number of values that the rows have."""


def find(result: RunResult, view: ViewSamples, rows: slice) -> Found:
    """Find samples that contradict others, by the materials of `ggx_normal`."""
    materials = result.materials(GGX_NORMAL.name, np.searchsorted(result.triangles, view.triangles[rows]))
    samples, beside = result.view_samples(view, rows), Neighbours.of(view.led_mm, result.middle_mm)
    with h5py.File(view.path, "r") as file:
        dark = contradiction_mask(samples, materials, file["u_own"][rows], beside)
        has_values = np.isfinite(file["f"][rows])
    return Found(rows, np.stack(np.nonzero(dark)), int(has_values[dark].sum()), int(has_values.sum()))


def leave_out(view: ViewSamples, found_contradictions: Iterable[Found]) -> None:
    """Take what contradicts others out of a view's file, which is whole, before or after. Raises OSError."""

    def write(part: Path) -> None:
        count = total = 0
        shutil.copyfile(view.path, part)
        with h5py.File(part, "r+") as file:
            for contradictions in found_contradictions:
                count, total = count + contradictions.values, total + contradictions.all_values
                if contradictions.places.size:
                    f, codes = file["f"][contradictions.rows], file["codes"][contradictions.rows]
                    f[*contradictions.places], codes[*contradictions.places] = np.nan, BY_UNKNOWN
                    file["f"][contradictions.rows], file["codes"][contradictions.rows] = f, codes
            file.attrs[CONTRADICTED], file.attrs[SAMPLES] = count, total - count

    rewrite(view.path, write)

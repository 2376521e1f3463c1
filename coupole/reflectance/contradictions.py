"""Samples that are shaded by a thing that no description contains, for example a cable. Such samples contradict
the samples of neighbouring LEDs.

A cable's full shadow is too dark to give samples. At the shadow's edge a triangle is partly lit, and its sample
can be too low by any amount. A contradicted sample is darker than the triangle's material in all channels, by more
than its noise allows. The material there is mostly diffuse, so the form of a lobe is not the cause. The
neighbouring LEDs agree with the material, so neither the triangle nor the model is wrong.
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

from coupole.kernels import kernel
from coupole.reflectance.discarded_frames import rewrite
from coupole.reflectance.extraction.sample_codes import BY_UNKNOWN
from coupole.reflectance.fits import GGX_NORMAL
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.run_result import CONTRADICTED, SAMPLES, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, model_values, towards
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float64]

BESIDE = 6
"""Number of neighbouring LEDs with which an LED is compared."""
_FEWEST_BESIDE = 4
"""Least number of these LEDs that must have a sample."""
_MOST_LEFT = 0.8
"""A sample counts as contradicted only if less than this share of its light is left."""
_AGREE = (0.9, 1.15)
"""Range in which the median ratio of neighbouring LEDs to the material counts as agreement."""
_LEAST_DIFFUSE = 0.5
"""Least diffuse share of the material's value."""
_SIGMA = 5.0
_PART = 256
"""Number of triangles that a thread works on at a time."""


@dataclass(frozen=True)
class Neighbours:
    """LEDs beside each LED of a view."""

    places: NDArray[np.int64]
    """[leds, BESIDE]"""

    @classmethod
    def of(cls, led_mm: Floats, middle_mm: Floats) -> Neighbours:
        """Return, for each LED, the LEDs in the nearest directions, as seen from the object's middle."""
        ways = led_mm - middle_mm
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        if len(ways) < 2:
            return cls(np.zeros((len(ways), 0), np.int64))
        return cls(np.asarray(cKDTree(ways).query(ways, k=range(2, min(BESIDE, len(ways) - 1) + 2))[1], np.int64))


def contradiction_mask(
    samples: TriangleSamples,
    materials: TriangleMaterials,
    u_noise: NDArray[np.float16],
    beside: Neighbours,
    *,
    threads: int | None = None,
) -> NDArray[np.bool_]:
    """[b, leds] True for contradicted samples of one view, by materials [b] and relative noise [b, leds,
    channels]."""
    whole = model_values(samples, materials)
    dark = np.zeros(whole.shape[:2], np.bool_)

    def mark(first: int) -> None:
        part = slice(first, first + _PART)
        _mark(
            samples.values[part], whole[part], u_noise[part].astype(np.float32), samples.led_mm,
            samples.centres_mm[part], materials.normals[part], materials.kd[part], beside.places, dark[part],
        )  # fmt: skip

    in_threads(mark, len(dark), part=_PART, threads=threads)
    return dark


@kernel(error_model="numpy")
def _mark(values, whole, u_noise, led_mm, centres_mm, normals, kd, places_beside, dark):  # type: ignore[no-untyped-def]
    """Mark the samples of LEDs that contradict the samples of the LEDs beside them."""
    count, leds, _ = values.shape
    mean, way, ratios_beside = np.empty(leds), np.empty(3), np.empty(places_beside.shape[1])
    for triangle in range(count):
        any_is_low = False
        for led in range(leds):
            towards(centres_mm[triangle], led_mm[led], way)
            cosine = 0.0
            for k in range(3):
                cosine += way[k] * normals[triangle, k]
            is_low, mean[led] = _compare(
                values[triangle, led], whole[triangle, led], u_noise[triangle, led], kd[triangle], max(cosine, 0.0)
            )
            dark[triangle, led] = is_low
            any_is_low |= is_low
        for led in range(leds if any_is_low else 0):
            if dark[triangle, led]:
                dark[triangle, led] = _is_darker(mean, places_beside[led], mean[led], ratios_beside)


@kernel(error_model="numpy")
def _compare(values, whole, u_noise, kd, cosine):  # type: ignore[no-untyped-def]
    """Tell whether a sample is darker than the material in all its channels, by more than its noise. Also return
    the sample's mean over the channels, divided by the material's mean; NaN if there is no such ratio."""
    count, low_count, total = 0, 0, 0.0
    for channel in range(len(values)):
        ratio = values[channel] / whole[channel]
        if not np.isfinite(ratio):
            continue
        count, total = count + 1, total + ratio
        diffuse = kd[channel] * cosine / whole[channel]
        is_less = ratio < _AGREE[0] and ratio + _SIGMA * u_noise[channel] * ratio < 1.0  # never of unknown noise
        low_count += is_less and diffuse > _LEAST_DIFFUSE
    return count > 0 and low_count == count, total / count if count else np.nan


@kernel
def _is_darker(mean, places, own_ratio, ratios_beside):  # type: ignore[no-untyped-def]
    """Tell whether an LED is darker than the material while the LEDs beside it, `places` in `mean`, agree with the
    material; `ratios_beside` is working memory."""
    count = 0
    for place in places:
        if np.isfinite(mean[place]):
            ratios_beside[count] = mean[place]
            count += 1
    if count < _FEWEST_BESIDE:
        return False
    middle = np.median(ratios_beside[:count])
    return _AGREE[0] < middle < _AGREE[1] and own_ratio < _MOST_LEFT * middle


@dataclass(frozen=True)
class Found:
    """Samples that contradict others, in some rows of a view's file."""

    rows: slice
    places: NDArray[np.int64]
    """[2, n] rows, from the first row on, and LEDs."""
    values: int
    """Number of values that these samples have."""
    all_values: int
    """Number of values that the rows have."""


def find(result: RunResult, view: ViewSamples, rows: slice, threads: int | None = None) -> Found:
    """Find samples that contradict others, by the materials of `ggx_normal`."""
    materials = result.materials(GGX_NORMAL.name, np.searchsorted(result.triangles, view.triangles[rows]))
    samples, beside = result.view_samples(view, rows), Neighbours.of(view.led_mm, result.middle_mm)
    with h5py.File(view.path, "r") as file:
        dark = contradiction_mask(samples, materials, file["u_own"][rows], beside, threads=threads)
        has_values = np.isfinite(file["f"][rows])
    return Found(rows, np.stack(np.nonzero(dark)), int(has_values[dark].sum()), int(has_values.sum()))


def leave_out(view: ViewSamples, found_contradictions: Iterable[Found]) -> None:
    """Remove contradicted samples from a view's file. The file is complete at all times, either the old one or the
    new one. Raises OSError."""

    def write(part: Path) -> None:
        count = total = 0
        shutil.copyfile(view.path, part)
        with hdf5_file(part, "r+") as file:
            for contradictions in found_contradictions:
                count, total = count + contradictions.values, total + contradictions.all_values
                if contradictions.places.size:
                    f, codes = file["f"][contradictions.rows], file["codes"][contradictions.rows]
                    f[*contradictions.places], codes[*contradictions.places] = np.nan, BY_UNKNOWN
                    file["f"][contradictions.rows], file["codes"][contradictions.rows] = f, codes
            file.attrs[CONTRADICTED], file.attrs[SAMPLES] = count, total - count

    rewrite(view.path, write)

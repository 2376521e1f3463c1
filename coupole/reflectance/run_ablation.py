"""Dependence of each fit on the number of LEDs, on grazing samples and on the number of coefficients.

Some triangles of a result, spread over it, are fitted again with fewer samples or coefficients. The fits are
compared under LEDs that were left out of all fits (Lucat et al. 2025, 6.3 and 6.4).
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.fits import FITS, MATERIALS, SLICES
from coupole.reflectance.least_squares import one_thread
from coupole.reflectance.result_folder import read_settings
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.slice_basis import fewer
from coupole.reflectance.slice_fit import fit_slices, slice_values
from coupole.reflectance.triangle_fit import TriangleSamples
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced

Floats = NDArray[np.float64]

Said = Callable[[str, int, int], None]
ABLATION = "ablation.json"
LED_STEPS = (1, 2, 4, 8)
"""Steps between the LEDs that are used: every LED, every second, and so on."""
MOST_INCIDENCES_DEG = (89, 80, 70, 60)
COEFFICIENTS = (100, 64, 36, 16)
_BLOCKS, _TRIANGLES = 16, 48
"""Number of places that are taken from the result, and number of neighbouring triangles at each place."""


@dataclass(frozen=True)
class Variant:
    """Samples and coefficients that a fit may use."""

    led_step: int = 1
    most_incidence_deg: float = 89
    coefficients: int = 100


Variants = dict[str, list[tuple[float, Variant]]]
"""Values of each setting with the variant of the data for each value, by the setting's name."""
FEWER_SAMPLES: Variants = {
    "share of the LEDs": [(1.0 / step, Variant(led_step=step)) for step in LED_STEPS],
    "most incidence, degrees": [(deg, Variant(most_incidence_deg=deg)) for deg in MOST_INCIDENCES_DEG],
}
VARIANTS: Variants = {
    **FEWER_SAMPLES,
    "coefficients": [(count, Variant(coefficients=count)) for count in COEFFICIENTS],
}


def leds_of(variant: Variant, leds: NDArray[np.integer], left_out: list[int]) -> NDArray[np.integer]:
    """Return the LEDs, of those of some samples, that a variant is fitted to."""
    return np.setdiff1d(leds, left_out)[:: variant.led_step]


def incidence_deg(places_mm: NDArray[np.floating], normals: Floats, led_mm: Floats) -> Floats:
    """[n, leds] angles of incidence at places [n, 3] with normals [n, 3]."""
    ways = led_mm - places_mm[:, None]
    cosine = np.einsum("nsk,nk->ns", ways, normals) / np.linalg.norm(ways, axis=2)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def ablate_result(out: Path, *, say: Said = lambda step, done, of: None) -> dict[str, Any]:
    """Return, for each setting, the mean absolute error of each fit as a share of the camera's range, and write it
    to the result. Raises InputError if the result lacks samples, StorageError if the disk cannot be written."""
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings)
    variants = {variant for steps in VARIANTS.values() for _, variant in steps}
    blocks = _blocks(result)
    errors: dict[Variant, dict[str, list[Floats]]] = {variant: {} for variant in variants}

    def of_block(block: slice) -> dict[Variant, dict[str, Floats]]:
        case = _case(result, block, settings)
        return {variant: _errors(case, variant, settings["scan_noise_um"]) for variant in variants}

    with one_thread(), ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for count, errors_of_variants in enumerate(pool.map(of_block, blocks), start=1):
            for variant, of_fits in errors_of_variants.items():
                for name, off in of_fits.items():
                    errors[variant].setdefault(name, []).append(off)
            say("ablate", count, len(blocks))
    report = {"triangles": sum(block.stop - block.start for block in blocks), "mae": mean_errors(VARIANTS, errors)}
    try:
        write_synced(out / ABLATION, json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return report


def mean_errors(variants: Variants, errors: dict[Variant, dict[str, list[Floats]]]) -> dict[str, Any]:
    """Return for each setting and value the mean absolute error of each fit, None without any; `errors` are by
    variant and fit."""
    return {
        setting: [[value, {name: _mean(off) for name, off in errors[variant].items()}] for value, variant in steps]
        for setting, steps in variants.items()
    }


def _mean(off: list[Floats]) -> float | None:
    whole = np.concatenate(off)
    return float(np.abs(whole).mean()) if len(whole) else None


def _blocks(result: RunResult) -> list[slice]:
    """Return blocks of places in the result's `triangles`."""
    count = len(result.triangles)
    firsts = np.unique(np.linspace(0, max(0, count - _TRIANGLES), _BLOCKS).astype(int))
    return [slice(int(first), min(int(first) + _TRIANGLES, count)) for first in firsts]


@dataclass(frozen=True)
class _Case:
    """Samples of some triangles."""

    samples: TriangleSamples
    leds: NDArray[np.int64]
    """[samples]"""
    left_out: list[int]
    left_out_mask: NDArray[np.bool_]
    """[samples] True for samples under LEDs that were left out."""
    incidence_deg: Floats
    """[b, samples]"""
    share: Floats
    """[b, samples, channels] share of the camera's range for a value of 1."""


def _case(result: RunResult, block: slice, settings: dict[str, Any]) -> _Case:
    samples, leds = result.samples(block), result.along_samples(block, "leds")
    lit = lit_on(
        samples.centres_mm,
        samples.led_mm,
        result.along_samples(block, "led_normals"),
        settings["emission"] == "paper",
    )
    return _Case(
        samples,
        leds,
        settings["left_out"],
        np.isin(leds, settings["left_out"]),
        incidence_deg(samples.centres_mm, samples.normals, samples.led_mm),
        lit[..., None] * result.along_samples(block, "full_scales"),
    )


def _errors(case: _Case, variant: Variant, noise_um: float) -> dict[str, Floats]:
    """Return the errors of each fit under the LEDs that were left out, for samples where every fit has a value."""
    is_fitted = np.isin(case.leds, leds_of(variant, case.leds, case.left_out))
    values = np.where(case.incidence_deg[..., None] <= variant.most_incidence_deg, case.samples.values, np.nan)
    samples = replace(case.samples, values=values.astype(np.float32))
    models = {
        name: fit.values(samples, fit.fit(samples, is_fitted, noise_um, threads=1))
        for name, fit in MATERIALS.items()
    }
    values_of_fits = {name: np.full(values.shape, np.nan, np.float32) for name in SLICES} | models
    for view in range(len(samples.cameras_mm)):
        in_view = samples.view_of == view
        view_samples = replace(
            samples,
            values=samples.values[:, in_view],
            led_mm=samples.led_mm[in_view],
            view_of=samples.view_of[in_view] * 0,
            cameras_mm=samples.cameras_mm[view][None],
        )
        for name, fit in SLICES.items():
            model = None if fit.over is None else models[fit.over.name][:, in_view]
            basis = fewer(fit.basis, variant.coefficients)
            coefficients = fit_slices(view_samples, is_fitted[in_view], (basis, model), threads=1)[0]
            values_of_fits[name][:, in_view] = slice_values(view_samples, coefficients, basis, model)
    held_out_values = case.samples.values[:, case.left_out_mask]
    is_finite = np.isfinite(held_out_values)
    for fit_values in values_of_fits.values():
        is_finite &= np.isfinite(fit_values[:, case.left_out_mask])
    share = case.share[:, case.left_out_mask]
    return {
        name: ((values_of_fits[name][:, case.left_out_mask] - held_out_values) * share)[is_finite] for name in FITS
    }

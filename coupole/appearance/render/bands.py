"""Rendering of 81 bands with a renderer that carries four wavelengths along a path.

For every path, Mitsuba's spectral variants draw one wavelength from each quarter of the film's sensitivity. If a
film is sensitive to four neighbouring bands, each quarter has one of them. Spectra that are constant over each
band are then rendered without noise from the choice of wavelengths. Spectra that Mitsuba makes itself (a map of
the surroundings) have their mean over the band. With the same seed every group of four has the same random
numbers. So there is luminance noise, but hardly any colour noise. (Here a film of 81 channels with full spectra
took 5.6 times as long, and had three times the noise.)

Lights are known every 5 nm. With coarser steps, a rendered band has the light's mean around it, and `weights`
integrate over the light's own structure. Only the reflectances are interpolated (as in ASTM E308's tables).

A scene is described once, with an array [81] for each spectrum; `for_group` replaces it by Mitsuba's spectrum for
a group of bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from coupole.appearance.matter.baked_table import BakedTable
from coupole.appearance.spectra.grid import BANDS, STEP_NM, WAVELENGTHS_NM, Array

Description = dict[str, Any]
"""Argument of `mitsuba.load_dict`, with arrays [81] for spectra."""
StepNm = Literal[5, 10, 20, 40]
QUARTERS = 4
_RAMP_NM = 0.01
"""Width of the transition between two bands. With bands of 5 nm, the wavelength of one path in 500 is there."""


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of the film to one band of a group."""

    quarter: int


def rendered_bands(step_nm: StepNm) -> list[int]:
    """Return the numbers of the bands, among the 81, that are rendered."""
    return list(range(0, BANDS, step_nm // int(STEP_NM)))


def wavelengths(step_nm: StepNm) -> Array:
    return np.asarray(WAVELENGTHS_NM[rendered_bands(step_nm)])


def around_nodes(power: Array, step_nm: StepNm) -> Array:
    """Return a light's power [81] in which each rendered band has the mean around it (a triangle of twice the
    step)."""
    nodes = rendered_bands(step_nm)
    triangles = np.maximum(0.0, 1.0 - np.abs(WAVELENGTHS_NM[nodes][:, None] - WAVELENGTHS_NM) / step_nm)
    means = np.array(power, dtype=float)
    means[nodes] = (triangles @ power) / triangles.sum(axis=1)
    return means


def weights(functions: Array, power: Array, step_nm: StepNm) -> Array:
    """[n, bands] weights in nm. The sum of weights times radiance in the rendered bands is the integral of
    radiance times `functions` [n, 81], under the light `power` [81]. This is exact for reflectances that are cubic
    splines over the bands."""
    from scipy.interpolate import CubicSpline

    nodes = rendered_bands(step_nm)
    if step_nm == STEP_NM:
        return np.asarray(functions * STEP_NM)
    splines = CubicSpline(WAVELENGTHS_NM[nodes], np.eye(len(nodes)))(WAVELENGTHS_NM)
    means = around_nodes(power, step_nm)[nodes]
    lit = (functions * power) @ splines * STEP_NM
    return np.asarray(np.divide(lit, means, out=np.zeros_like(lit), where=means > 0.0))


def groups(step_nm: StepNm) -> list[list[int]]:
    """Bands in groups of four; the last group repeats its last band if it has fewer."""
    bands = rendered_bands(step_nm)
    parts = [bands[first : first + QUARTERS] for first in range(0, len(bands), QUARTERS)]
    return [part + [part[-1]] * (QUARTERS - len(part)) for part in parts]


def for_group(description: Any, group: Sequence[int], step_nm: StepNm, files: Path) -> Any:
    """Return the description with Mitsuba's spectra for the four bands of `group`. A `table` is written to the
    folder `files`."""
    if isinstance(description, np.ndarray):
        return _steps(description[list(group)], group, step_nm)
    if isinstance(description, Sensitivity):
        return _steps(np.eye(QUARTERS)[description.quarter], group, step_nm)
    if isinstance(description, dict):
        parts = {
            key: for_group(value, group, step_nm, files) for key, value in description.items() if key != "table"
        }
        if (table := description.get("table")) is not None:
            parts["filename"] = _write_table(table, group, step_nm, files)
        return parts
    return description


def _write_table(table: BakedTable, group: Sequence[int], step_nm: StepNm, files: Path) -> str:
    """Write the table as a file with the group's values over the quarters, and return its path. An earlier file is
    replaced, not changed, because it may still be open."""
    path, new = files / f"{id(table)}.bsdf", files / "new.bsdf"
    new.write_bytes(table.encode(_nodes_nm(group, step_nm), np.repeat(list(group), 2).tolist()))
    new.replace(path)
    return str(path)


def film(width_px: int, height_px: int) -> Description:
    """A film with a channel for each band of a group; box filters, so that results do not depend on threads."""
    return {
        "type": "specfilm",
        "width": width_px,
        "height": height_px,
        "component_format": "float32",
        "rfilter": {"type": "box"},
        **{f"quarter{k}": Sensitivity(k) for k in range(QUARTERS)},
    }


def _steps(values: Array, group: Sequence[int], step_nm: StepNm) -> Description:
    """Return a spectrum with `values` [4] over the bands; a group with fewer bands uses the bands after them
    too."""
    if not np.any(values):
        return {"type": "uniform", "value": 0.0}  # the other kind does not accept zero
    return {
        "type": "irregular",
        "wavelengths": ", ".join(f"{nm:.3f}" for nm in _nodes_nm(group, step_nm)),
        "values": ", ".join(f"{value:.9g}" for value in np.repeat(np.asarray(values, dtype=float), 2)),
    }


def _nodes_nm(group: Sequence[int], step_nm: StepNm) -> list[float]:
    """Begin and end of each of the four bands."""
    edges_nm = WAVELENGTHS_NM[group[0]] + step_nm * (np.arange(QUARTERS + 1) - 0.5)
    nodes = [edges_nm[0]]
    for edge in edges_nm[1:-1]:
        nodes += [edge - _RAMP_NM / 2, edge + _RAMP_NM / 2]
    return [*nodes, edges_nm[-1]]

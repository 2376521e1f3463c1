"""Cubes of drawn pigments for tests: areas whose truth is known, written by SPy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from spectral.io import envi

from coupole.appearance.matter import kubelka_munk, typical
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array

NM = np.linspace(400.0, 780.0, 96)
SHAPES = ("azurite", "lapis-lazuli", "malachite", "vermilion", "yellow ochre", "red lead")


def batch(shape: str, number: int) -> Array:
    """[81] reflectance of a batch: another concentration, edges some nm away, other impurities."""
    random = np.random.default_rng([SHAPES.index(shape), number])
    moved = np.interp(WAVELENGTHS_NM + random.normal(0.0, 2.0), WAVELENGTHS_NM, typical.reflectance(shape).values)
    grey = 0.05 * random.uniform()
    ratio = kubelka_munk.k_over_s(np.clip(moved, 0.01, 0.97))
    return kubelka_munk.opaque(random.uniform(0.6, 1.6) * ratio + grey)


def write_library(folder: Path, shapes: Sequence[str] = SHAPES) -> tuple[Path, Path]:
    """A library with six batches of each shape, and its classes, which have the shapes' names."""
    folder.mkdir(exist_ok=True)
    lines = ["name," + ",".join(f"{nm:g}" for nm in WAVELENGTHS_NM)]
    table = ["name,class"]
    for shape in shapes:
        for number in range(6):
            lines.append(f"{shape} {number}," + ",".join(f"{value:.5f}" for value in batch(shape, number)))
            table.append(f"{shape} {number},{shape}")
    (folder / "pigments.csv").write_text("\n".join(lines), encoding="utf-8")
    (folder / "classes.csv").write_text("\n".join(table), encoding="utf-8")
    return folder / "pigments.csv", folder / "classes.csv"


def areas(shapes: Sequence[str], side: int) -> tuple[Array, list[str]]:
    """[side, side x n, bands] reflectance of areas side by side, with noise and shading; the truth of each
    area."""
    random = np.random.default_rng(8)
    columns = []
    for shape in shapes:
        spectrum = np.interp(NM, WAVELENGTHS_NM, batch(shape, 99))
        shading = 1.0 + 0.02 * random.standard_normal((side, side, 1))
        columns.append(spectrum * shading + 0.004 * random.standard_normal((side, side, len(NM))))
    return np.concatenate(columns, axis=1), list(shapes)


def write_cube(header: Path, reflectance: Array, **options: Any) -> Path:
    """Write a cube as integers of 1/10000, and return its header's path."""
    metadata = {
        "wavelength": [f"{nm:.4f}" for nm in NM],
        "wavelength units": "Nanometers",
        "reflectance scale factor": 10000,
        **options.pop("metadata", {}),
    }
    counts = np.rint(10000 * np.clip(reflectance, 0.0, 3.0)).astype(np.uint16)
    envi.save_image(
        str(header),
        counts,
        dtype=options.pop("dtype", np.uint16),
        metadata=metadata,
        force=True,
        ext=".dat",
        **options,
    )
    return header

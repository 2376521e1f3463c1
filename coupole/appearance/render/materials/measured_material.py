"""Measured or exported materials from files: MERL's, RGL's and ALTA's formats, and our own results.

Mitsuba reads them as tables of RGL's format. Files of this format are used unchanged, all others are resampled.
Spectra are kept. Red, green and blue become smooth spectra by a published method; these spectra are not measured.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.appearance.matter.alta_samples import interpolated_brdf, read_alta
from coupole.appearance.matter.baked_table import BakedTable, bake, from_file, wavelengths_of
from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.matter.merl_table import read_merl
from coupole.appearance.matter.result_materials import read_result
from coupole.appearance.matter.rgl_table import RglTable, read_bsdf
from coupole.appearance.render.bands import Description
from coupole.appearance.render.model import Model
from coupole.appearance.render.variant import import_extra
from coupole.appearance.spectra.grid import BANDS, Array
from coupole.errors import InputError

_THETAS, _SIDE = 48, 96
_TURNS = 16
"""Number of turns over which an anisotropic surface is averaged."""


class MeasuredMaterial(Model):
    """A file `.binary` (MERL), `.bsdf` (RGL) or ALTA's text, or the folder of a result of `coupole
    reflectance`."""

    kind: Literal["measured"]
    path: Path
    fit: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")] = "ggx"
    """Fit that is used from a result: one with a material for each triangle."""
    cluster: Annotated[int, Field(ge=0)] | None = None
    """Cluster of a result; if not given, the mean of its triangles."""
    triangles: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] | None = None
    """Triangles of a result's mesh; the mean of their materials is used."""

    @model_validator(mode="after")
    def _one_region(self) -> MeasuredMaterial:
        if self.cluster is not None and self.triangles is not None:
            raise ValueError("give either `cluster` or `triangles`")
        return self


def measured_bsdf(material: MeasuredMaterial, folder: Path) -> Description:
    """Return one side of the material for Mitsuba. Raises InputError."""
    return {"type": "measured", "table": measured_table(material, folder)}


def measured_table(material: MeasuredMaterial, folder: Path) -> BakedTable:
    """Return the table for Mitsuba; paths are relative to `folder`. Raises InputError."""
    path = folder / material.path
    if path.suffix.lower() == ".bsdf":
        table = read_bsdf(path)
        to_bands = spectra_of_rgb() if table.wavelengths_nm is None else wavelengths_of(table)
        if table.isotropic:
            return from_file(path, table, to_bands)
        return bake(_turned_to_all_sides(table), to_bands, thetas=_THETAS, side=_SIDE)
    source = measured_brdf(material, folder)
    up = np.array([[0.0, 0.0, 1.0]])
    channels = source(up, up).shape[-1]
    if channels not in (1, 3):
        raise InputError(f"{path}: expected one or three values in each sample, found {channels}")
    return bake(source, np.ones((1, BANDS)) if channels == 1 else spectra_of_rgb(), thetas=_THETAS, side=_SIDE)


def measured_brdf(material: MeasuredMaterial, folder: Path) -> Brdf:
    """Return the BRDF in the file's own channels [..., channels], as the file's reader returns it. Raises
    InputError."""
    path = folder / material.path
    if path.is_dir():
        return read_result(path, material.fit, cluster=material.cluster, triangles=material.triangles)
    if material.cluster is not None or material.triangles is not None:
        raise InputError(f"{path}: `cluster` and `triangles` belong to the folder of a result; leave them out")
    match path.suffix.lower():
        case ".binary":
            return read_merl(path)
        case ".bsdf":
            return read_bsdf(path)
        case _:
            return interpolated_brdf(read_alta(path))


def spectra_of_rgb() -> Array:
    """[3, 81] reflectance spectra for red, green and blue of linear sRGB; they sum to 1.

    Mallett and Yuksel, Spectral primary decomposition for rendering with sRGB reflectance, EGSR 2019: smooth
    spectra with the primaries' colours under D65, 2 degrees, nowhere below 0.
    """
    functions = import_extra("colour", "materials").recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019
    return np.asarray(functions.values, dtype=float).T


def _turned_to_all_sides(table: RglTable) -> Brdf:
    """Return the mean over turns of the surface about its normal, because meshes have no direction of their
    own."""
    angles = 2.0 * np.pi * (np.arange(_TURNS) + 0.5) / _TURNS
    turns = [np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in angles]

    def mean(wi: Array, wo: Array) -> Array:
        return np.asarray(sum(table(wi @ turn, wo @ turn) for turn in turns) / len(turns))

    return mean

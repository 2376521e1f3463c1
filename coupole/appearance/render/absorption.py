"""Absorption of light on its way through a clear medium, per mm (Beer and Lambert)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, assert_never

import numpy as np
from pydantic import Field

from coupole.appearance.matter import lacquer
from coupole.appearance.render.model import Model, Positive
from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM, Array
from coupole.appearance.spectra.measured import read_spectrum
from coupole.appearance.spectra.resampling import fill_missing, on_grid

NotNegative = Annotated[float, Field(ge=0)]


class NumbersFile(Model):
    """Numbers by wavelength, in columns of a file; beyond its ends, the last numbers are used."""

    kind: Literal["file"]
    path: Path
    column: int | None = None


PerMm = NotNegative | NumbersFile
"""A coefficient per mm, one number for all wavelengths or numbers from a file."""


class Urushi(Model):
    """Absorption of transparent urushi, an assumed shape (`lacquer.urushi_absorption`)."""

    kind: Literal["urushi"]
    at_450_nm_per_mm: NotNegative = 6.0
    fall_per_nm: Positive = 0.016


class TypicalVarnish(Model):
    """Absorption of a yellowing varnish of natural resin: an assumed shape, no measured varnish.

    The absorption is age k exp(-fall (w - 450 nm)): strong in the violet, nearly zero in the red.
    """

    kind: Literal["typical_varnish"]
    age: NotNegative
    """0 for fresh and clear, 1 for strongly yellowed."""
    at_450_nm_per_mm: NotNegative = 15.0
    """Coefficient at 450 nm and age 1."""
    fall_per_nm: Positive = 0.018


class Absorbance(Model):
    """A film's measured decadic absorbance by wavelength. It is the difference between an aged and a fresh film,
    or the absorbance of one film without the effect of its faces."""

    kind: Literal["absorbance"]
    path: Path
    column: int | None = None
    film_mm: Positive
    """Thickness of the film that was measured."""
    age: NotNegative = 1.0
    """Age, as a multiple of the measured film's age."""


class AbsorptionPerMm(Model):
    kind: Literal["values"]
    per_mm: PerMm
    """Natural coefficient, for directed light."""


class Transmittance(Model):
    """Transmittance of a free film of known thickness, measured with its two faces."""

    kind: Literal["file"]
    path: Path
    column: int | None = None
    thickness_mm: Positive


Absorption = Annotated[
    Urushi | TypicalVarnish | Absorbance | AbsorptionPerMm | Transmittance, Field(discriminator="kind")
]


def per_mm(absorption: Absorption, index: float, folder: Path) -> Array:
    """[81] natural coefficients per mm for directed light in a medium of `index`; paths are relative to `folder`.
    Raises InputError."""
    match absorption:
        case Urushi():
            return lacquer.urushi_absorption(absorption.at_450_nm_per_mm, absorption.fall_per_nm)
        case TypicalVarnish():
            shape = np.exp(-absorption.fall_per_nm * (WAVELENGTHS_NM - 450.0))
            return np.asarray(absorption.age * absorption.at_450_nm_per_mm * shape)
        case Absorbance():
            decadic = _numbers(folder / absorption.path, absorption.column)
            return np.asarray(absorption.age * np.log(10.0) * decadic / absorption.film_mm)
        case AbsorptionPerMm():
            return coefficient(absorption.per_mm, folder)
        case Transmittance():
            spectrum = read_spectrum(folder / absorption.path, column=absorption.column)
            return lacquer.absorption_from(fill_missing(on_grid(spectrum)), absorption.thickness_mm, index)
        case _:
            assert_never(absorption)


def coefficient(value: PerMm, folder: Path) -> Array:
    """[81] coefficients per mm. Raises InputError."""
    if isinstance(value, NumbersFile):
        return _numbers(folder / value.path, value.column)
    return np.full(BANDS, value)


def _numbers(path: Path, column: int | None) -> Array:
    """[81], not below 0."""
    spectrum = read_spectrum(path, unit="power", column=column)
    return np.asarray(np.maximum(fill_missing(on_grid(spectrum)), 0.0))

"""Indices of refraction in a scene file: a number, a formula of dispersion, or a user's file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from coupole.appearance.optics import index_file, indices
from coupole.appearance.render.model import Index, Model
from coupole.appearance.spectra.grid import Array, Complex, within
from coupole.errors import InputError


class Cauchy(Model):
    """n = a + b/w^2 + c/w^4, w in micrometres."""

    kind: Literal["cauchy"]
    a: float
    b_um2: float
    c_um4: float = 0.0


class Sellmeier(Model):
    """n^2 = 1 + sum B w^2/(w^2 - C), w in micrometres."""

    kind: Literal["sellmeier"]
    terms: Annotated[tuple[tuple[float, float], ...], Field(min_length=1, max_length=6)]
    """B, and C in um^2."""


class Acrylic(Model):
    """PMMA, Sultanova et al. 2009."""

    kind: Literal["acrylic"]


class IndexFile(Model):
    """A user's file of wavelength, n and k (`coupole.appearance.optics.index_file`)."""

    kind: Literal["file"]
    path: Path


Dispersion = Annotated[Cauchy | Sellmeier | Acrylic | IndexFile, Field(discriminator="kind")]
Refraction = Index | Dispersion


def complex_index(refraction: Refraction, folder: Path) -> Complex:
    """n + i k [81]; paths are relative to `folder`. Raises InputError."""
    match refraction:
        case Cauchy():
            return indices.cauchy(refraction.a, refraction.b_um2, refraction.c_um4)
        case Sellmeier():
            return indices.sellmeier(refraction.terms)
        case Acrylic():
            return indices.acrylic()
        case IndexFile():
            return index_file.read_index(folder / refraction.path)
        case _:
            return indices.constant(refraction)


def real_index(refraction: Refraction, folder: Path) -> Array:
    """n [81] of a transparent material. Raises InputError if the material absorbs."""
    index = complex_index(refraction, folder)
    if np.any(index.imag > 1e-3):
        raise InputError(
            f"index: expected a transparent material, found k up to {index.imag.max():g}; give the index of a "
            "binder"
        )
    return within("index of a binder", index.real, 1.0 + 1e-9, 3.0)

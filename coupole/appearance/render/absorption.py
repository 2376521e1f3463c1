"""What a transparent body takes from light on its way through it, per mm (Beer and Lambert)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, assert_never

from pydantic import Field

from coupole.appearance.matter import lacquer
from coupole.appearance.render.model import Model, Positive
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import read_spectrum
from coupole.appearance.spectra.resampling import held, on_grid


class Urushi(Model):
    """Transparent urushi, of an assumed shape (`lacquer.urushi_absorption`)."""

    kind: Literal["urushi"]
    at_450_nm_per_mm: Positive = 6.0
    fall_per_nm: Positive = 0.016


class Transmittance(Model):
    """Of a free film of known thickness, measured with its two faces."""

    kind: Literal["file"]
    path: Path
    column: int | None = None
    thickness_mm: Positive


Absorption = Annotated[Urushi | Transmittance, Field(discriminator="kind")]


def per_mm(absorption: Absorption, index: float, folder: Path) -> Array:
    """[81] per mm in a medium of `index`; paths are relative to `folder`. Raises InputError."""
    match absorption:
        case Urushi():
            return lacquer.urushi_absorption(absorption.at_450_nm_per_mm, absorption.fall_per_nm)
        case Transmittance():
            found = read_spectrum(folder / absorption.path, column=absorption.column)
            return lacquer.absorption_from(held(on_grid(found)), absorption.thickness_mm, index)
        case _:
            assert_never(absorption)

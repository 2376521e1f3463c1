"""A cell whose frames under single LEDs are read: the places of its parts, and the calibrations of its frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from coupole.calibration import optics
from coupole.calibration.light.irradiance import Emission
from coupole.calibration.light.records import record_input
from coupole.calibration.light.tile_views import Positions
from coupole.calibration.rotations import Floats


@dataclass(frozen=True, kw_only=True)
class LitCell:
    """Support, LEDs and lens of a cell, and the records with which its frames are read."""

    base_from_support: Floats
    """[4, 4] mm"""
    positions: Positions
    """The LEDs' positions."""
    lens: optics.Intrinsics
    dark: Path | None = None
    response: Path | None = None
    flat: Path | None = None
    glare: Path | None = None
    emission: Emission = "lambertian"
    files: tuple[Path, ...] = ()
    """Files of the artefact, support and LEDs: inputs of the record."""

    @property
    def inputs(self) -> tuple[tuple[str, str], ...]:
        """Name and SHA-256 of all these files."""
        made_with = (*self.files, self.dark, self.response, self.flat, self.glare)
        return tuple(pair for path in made_with for pair in record_input(path))

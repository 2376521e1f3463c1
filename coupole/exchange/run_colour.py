"""Colours of a run's frames: tables of spectra, and the white that the run's records have measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coupole.calibration.record import read_record
from coupole.errors import InputError
from coupole.exchange.camera_colour import CameraColour, Floats, Neutral, camera_colour
from coupole.plan.reading import read_plan
from coupole.reflectance.extraction.measured_run import read_powers
from coupole.storage.run import Run

_HOW = "give a table of nm, power with --led-spectrum, or name it in the rig (dome.spectrum)"


@dataclass(frozen=True)
class ColourWanted:
    """Tables and records that determine the colours of frames."""

    sensor: Path
    """Table with the columns nm, red, green, blue."""
    leds: Path | None
    """Table with the columns nm, power; None for the rig's table."""
    records: tuple[Path, ...] = ()
    """Records that replace those that the run names."""
    is_linear: bool = False
    """True for a TIFF with linear values, in place of sRGB for the eye."""


def colour_of_run(run: Run, colour_request: ColourWanted) -> CameraColour:
    """Return the colours of a run. Raises InputError if there is no table of the LEDs' spectrum, or if a table is
    wrong, or without colour-science."""
    files = read_plan(run.plan_path, run.rig_path)
    leds, rig_spectrum = colour_request.leds, files.cell.rig.dome.spectrum
    if leds is None and rig_spectrum is None:
        raise InputError(f"{run.folder}: its rig names no spectrum of the LEDs; {_HOW}")
    if leds is None and rig_spectrum is not None:
        leds = files.cell.document.resolve(rig_spectrum)
    assert leds is not None
    return camera_colour(
        colour_request.sensor, leds, _measured_white(colour_request.records or files.record_paths or ())
    )


def _measured_white(records: Sequence[Path]) -> Neutral | None:
    """Return white as the record of the LEDs' power measured it, if one is named."""
    power_records = [path for path in records if read_record(path).kind == "led-power"]
    if not power_records:
        return None
    powers = read_powers(power_records[0], ("R", "G", "B"))
    lit_powers = powers.power[(powers.power > 0.0).all(axis=1)]
    usual: Floats = np.median(lit_powers / lit_powers.max(axis=1, keepdims=True), axis=0)

    def neutral(led: int | None) -> Floats:
        if led is None or led not in powers.ids:
            return usual
        power: Floats = powers.of(np.array([led])).power[0]
        return np.asarray(power / power.max()) if (power > 0.0).all() else usual

    return neutral

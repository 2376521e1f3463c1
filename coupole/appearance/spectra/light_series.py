"""A light's measured spectra at several times: `wavelength_nm` and a column for each time, in absolute units.

The first line names the columns: the wavelength, then times in ISO 8601 with their offset from UTC, in rising
order. Values are spectral irradiances in W/(m^2 nm) on a surface that faces the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from coupole.appearance.spectra import resampling
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import parse_spectrum
from coupole.errors import InputError

_FORM = "ISO 8601 times with their offset from UTC"


@dataclass(frozen=True)
class LightSeries:
    file: str
    times: tuple[datetime, ...]
    """Times in rising order."""
    irradiances: Array
    """[times, 81], W/(m^2 nm)."""

    def at(self, when: datetime) -> Array:
        """[81] irradiance, interpolated linearly between the two neighbours in time. Raises InputError outside the
        series."""
        first, last = self.times[0], self.times[-1]
        if not first <= when <= last:
            raise InputError(
                f"{self.file}: expected a time from {first.isoformat()} to {last.isoformat()}, found "
                f"{when.isoformat()}; choose one of these, or measure longer"
            )
        seconds = np.array([(time - first).total_seconds() for time in self.times])
        when_s = (when - first).total_seconds()
        return np.array([np.interp(when_s, seconds, band) for band in self.irradiances.T])


def read_series(path: Path) -> LightSeries:
    """Read a file of spectra. Raises InputError with file and line."""
    text = path.read_text("utf-8-sig")
    header = text.split("\n", 1)[0].strip()
    mark = next((mark for mark in ("\t", ";", ",") if mark in header), None)
    fields = [field.strip() for field in header.split(mark)][1:]
    times = tuple(_time(field, path) for field in fields)
    if len(times) < 2:
        raise InputError(f"{path}:1: expected at least two times after the wavelength, found {len(times)}")
    for before, after in pairwise(times):
        if after <= before:
            raise InputError(
                f"{path}:1: expected rising times, found {after.isoformat()} after {before.isoformat()}"
            )
    body = "#" + text  # the reader of spectra takes the names as a comment, and lines keep their numbers
    spectra = [parse_spectrum(body, str(path), unit="power", column=column) for column in range(1, len(times) + 1)]
    irradiances = [np.maximum(resampling.fill_missing(resampling.on_grid(spectrum)), 0.0) for spectrum in spectra]
    return LightSeries(str(path), times, np.array(irradiances))


def _time(text: str, path: Path) -> datetime:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"{path}:1: expected columns named by {_FORM}, found {text!r}") from None
    if time.tzinfo is None:
        raise InputError(f"{path}:1: expected {_FORM}, found {text}; for example {text}+02:00")
    return time

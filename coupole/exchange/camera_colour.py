"""Colours of frames for the eye, in CIE XYZ: from a chart's record, or from the sensor's sensitivities and the
LEDs' spectrum.

The transform by spectra is the linear transform with the smallest mean error over smooth reflectances. The error
is the difference from the colour of the same surface under daylight (D65) for the 1931 observer; the perfect white
is exact. Reflectances are modelled as a random process over wavelength with a Gaussian covariance (Wiener
estimation: Pratt and Mancill, Spectral estimation techniques for the spectral calibration of a color image
scanner, Applied Optics 15, 1976).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, reason

Floats = NDArray[np.float64]
Neutral = Callable[[int | None], Floats]
"""[3] values of the channels for white under an LED, by the LED's id. The greatest value is 1."""

_NOISE = 0.02
"""Share of a table's greatest value by which a value may be below 0."""
D65_CODE = 21
"""Code of D65 in EXIF's LightSource."""
_LARGEST_CONDITION = 1e5
"""Largest condition number of the covariance of the channels' values of reflectances; for real sensors it is below
1e4."""
_CORRELATED_NM = 50.0
"""Correlation length of reflectances: the standard deviation of their covariance over wavelength."""


@dataclass(frozen=True)
class CameraColour:
    """Colours of a camera under the LEDs, as far as they are known."""

    xyz_from_balanced: Floats | None
    """[3, 3] matrix to XYZ under D65 (Y = 1 for white) from red, green, blue that are 1, 1, 1 for white; None if
    it is not known."""
    neutral: Neutral
    origin: str
    """Source of these colours, in words."""


def unknown_colour() -> CameraColour:
    """Return the colours of a camera about which nothing is known."""
    origin = "not calibrated: ColorMatrix1 is the identity, AsShotNeutral is 1 1 1"
    return CameraColour(None, lambda led: np.ones(3), origin)


def camera_colour(sensor: Path, leds: Path, white_of_leds: Neutral | None = None) -> CameraColour:
    """Compute the colours from tables of the sensor's sensitivities (nm, red, green, blue; relative to each other)
    and of the LEDs' spectral power (nm, power). `white_of_leds` are the channels' measured values of white, if a
    record has them.

    Raises InputError for other tables, for channels that cannot distinguish colours, and without colour-science,
    which has the CIE's observer.
    """
    from coupole.appearance.spectra.grid import WAVELENGTHS_NM
    from coupole.appearance.spectra.light import illuminant, observer

    sensitivities = np.stack([_spectrum(sensor, column) for column in (1, 2, 3)])
    signals = sensitivities * _spectrum(leds, 1)
    white = signals.sum(axis=1)
    if not (white > 0.0).all():
        raise InputError(f"{sensor}: one channel sees no light of {leds}; check both tables")
    try:
        functions, daylight = observer("2 deg"), illuminant("D65")
    except ImportError as error:
        raise InputError(
            f"colour for the eye needs colour-science: pip install coupole[materials] ({error})"
        ) from error
    towards = functions * daylight / (functions[1] @ daylight)
    apart = (WAVELENGTHS_NM[:, None] - WAVELENGTHS_NM) / _CORRELATED_NM
    covariance = np.exp(-0.5 * apart**2) + 1.0
    white_balance = signals / white[:, None]
    if np.linalg.cond(white_balance @ covariance @ white_balance.T) > _LARGEST_CONDITION:
        raise InputError(
            f"{sensor}: its channels are too similar under the light of {leds} to distinguish colours; expected "
            "sensitivities of red, green and blue that have different shapes"
        )
    matrix = _least_missing(white_balance, towards, covariance)
    neutral = white / white.max()
    source = "measured by the record of the LEDs' power" if white_of_leds is not None else "by the spectra"
    origin = f"XYZ under D65, 1931 observer, by the spectra {sensor.name} and {leds.name}; white {source}"
    return CameraColour(matrix, white_of_leds or (lambda led: neutral), origin)


def _least_missing(signals: Floats, towards: Floats, covariance: Floats) -> Floats:
    """[3, 3] Wiener's matrix from `signals` [3, 81] to `towards` [3, 81], corrected so that white is exact."""
    within = signals @ covariance @ signals.T
    free = np.linalg.solve(within, signals @ covariance @ towards.T).T
    white = signals.sum(axis=1)
    direction = np.linalg.solve(within, white)
    white_error = towards.sum(axis=1) - free @ white
    return np.asarray(free + np.outer(white_error, direction) / (direction @ white))


def _spectrum(path: Path, column: int) -> Floats:
    """[81] values of a column of a table; beyond the ends of the table they are 0."""
    from coupole.appearance.spectra.measured import read_spectrum
    from coupole.appearance.spectra.resampling import on_grid

    try:
        spectrum = on_grid(read_spectrum(path, unit="power", column=column)).values
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot read the table of spectra: {reason(error)}") from error
    values: Floats = np.nan_to_num(spectrum)
    if values.min() < -_NOISE * values.max():
        raise InputError(f"{path}: column {column} goes below 0; expected relative sensitivities or power")
    return np.maximum(values, 0.0)


def colour_of_record(path: Path) -> CameraColour:
    """Take the colours from the matrix of a record of `coupole calibrate colour`, adapted from D50 to D65.

    Raises InputError for another record, or if the record exceeds its limits.
    """
    from coupole.calibration.colour.colorimetry import d65_from_d50
    from coupole.calibration.colour.colour_workflow import MATRIX
    from coupole.calibration.earlier import read_accepted

    record = read_accepted(path, "colour")
    matrix = np.array([[record.value(f"{MATRIX}{axis}{channel}") for channel in "rgb"] for axis in "XYZ"])
    neutral = np.array([record.value(f"neutral.{channel}") for channel in "RGB"])
    origin = f"XYZ under D65 by the chart of the record {record.name} ({record.sha256[:12]}); white by the chart"
    return CameraColour(d65_from_d50() @ matrix, lambda led: neutral, origin)

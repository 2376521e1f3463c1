"""Spatial frequency response from a slanted edge, and the place of the edge in each colour.

The method is that of ISO 12233:2017, annex D (e-SFR), with two differences. First, the edge's line (a parabola,
because lenses bend it) is fitted to all pixels at once, instead of centroids by rows. So pixels of one colour of a
RAW frame can be used at their places, without interpolation. Second, not only the derivative but also the width of
the bins is corrected for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_BIN_PX = 0.25
_LEAST_PIXELS = 60
_REACH_PX = 3.0
"""Least width of each side of the edge."""
_LEAST_CONTRAST = 0.2
"""Least contrast of an edge, (light - dark) / (light + dark)."""
_LEAST_SLANT_DEG = 1.0
"""Least slant of an edge against the pixels' rows and columns. With a smaller slant, bins would be empty or
biased."""


@dataclass(frozen=True)
class SlantedEdge:
    """An edge in one colour."""

    normal: Floats
    """[2] unit, from dark to light, x right, y down."""
    offset_px: float
    """Offset of the edge at the middle of the pixels, along the normal, from `middle_px`."""
    middle_px: Floats
    """[2]."""
    frequencies: Floats
    """[n] cycles per pixel."""
    response: Floats
    """[n], 1 at frequency 0."""

    def frequency_at(self, share: float) -> float:
        """Return the first frequency at which the response falls to a share, cycles per pixel. The sampling's
        limit is 0.5. The result is infinite if the response never falls so far."""
        below = np.flatnonzero(self.response <= share)
        if not len(below):
            return float("inf")
        n = int(below[0])
        high, low = self.response[n - 1], self.response[n]
        step = self.frequencies[n] - self.frequencies[n - 1]
        return float(self.frequencies[n - 1] + step * (high - share) / (high - low))


def slanted_edge(x_px: Floats, y_px: Floats, values: Floats, where: str = "edge") -> SlantedEdge:
    """Find the edge in pixels at x [n], y [n] with linear values [n].

    Raises InputError if there are too few pixels, no contrast or no room beside the edge, or if the edge is along
    the pixels' rows or columns. The message names the edge by `where`.
    """
    from scipy.optimize import least_squares

    if len(values) < _LEAST_PIXELS:
        raise InputError(f"{where}: expected {_LEAST_PIXELS} pixels or more about the edge, found {len(values)}")
    middle = np.array([x_px.mean(), y_px.mean()])
    x, y = x_px - middle[0], y_px - middle[1]
    dark, light = np.quantile(values, [0.1, 0.9])
    if light - dark < _LEAST_CONTRAST * (light + dark):
        raise InputError(f"{where}: expected an edge between light and dark, found {dark:.4g} and {light:.4g}")
    bright = values > 0.5 * (dark + light)
    towards = np.array([x[bright].mean() - x[~bright].mean(), y[bright].mean() - y[~bright].mean()])
    start = [np.arctan2(towards[1], towards[0]), 0.0, 0.0, 0.7, dark, light]

    def residuals_of(unknowns: Floats) -> Floats:
        return np.asarray((_model(unknowns, x, y) - values) / (light - dark))

    fit = least_squares(residuals_of, start, x_scale=[0.01, 0.1, 1e-4, 0.2, light - dark, light - dark])
    angle, offset, bend, _, low, high = fit.x
    slant_deg = np.degrees(abs((angle + np.pi / 4.0) % (np.pi / 2.0) - np.pi / 4.0))
    if slant_deg < _LEAST_SLANT_DEG:
        raise InputError(
            f"{where}: the edge is {slant_deg:.2g} degrees from the pixels' rows or columns; turn the chart by "
            "about 5 degrees"
        )
    away = _distance(angle, offset, bend, x, y)
    if min(-away.min(), away.max()) < _REACH_PX:
        raise InputError(
            f"{where}: expected {_REACH_PX:g} pixels or more on either side of the edge; correct its place"
        )
    frequencies, response = _response(away, (values - low) / (high - low))
    normal = np.array([np.cos(angle), np.sin(angle)])
    return SlantedEdge(normal, float(offset), middle, frequencies, response)


def _distance(angle: float, offset: float, bend: float, x: Floats, y: Floats) -> Floats:
    """Return the distance [n] from the edge along its normal, towards the light."""
    along = -x * np.sin(angle) + y * np.cos(angle)
    return np.asarray(x * np.cos(angle) + y * np.sin(angle) - offset - bend * along**2)


def _model(unknowns: Floats, x: Floats, y: Floats) -> Floats:
    from scipy.special import ndtr

    angle, offset, bend, spread_px, low, high = unknowns
    return np.asarray(low + (high - low) * ndtr(_distance(angle, offset, bend, x, y) / max(abs(spread_px), 0.05)))


def _response(away: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return frequencies and the modulus of the transform of the line spread, from values over distances."""
    reach = min(-away.min(), away.max())
    half = int(reach / _BIN_PX)
    number = np.floor(away / _BIN_PX).astype(int) + half
    inside = (number >= 0) & (number < 2 * half)
    count = np.bincount(number[inside], minlength=2 * half)
    total = np.bincount(number[inside], values[inside], minlength=2 * half)
    # Where the bin's pixels lie within it matters at high frequencies: each bin stands at their mean.
    place = np.bincount(number[inside], away[inside], minlength=2 * half)
    full = count > 0
    middles = (np.arange(2 * half) - half + 0.5) * _BIN_PX
    edge = np.interp(middles, place[full] / count[full], total[full] / count[full])
    line = np.zeros_like(edge)
    line[1:-1] = 0.5 * (edge[2:] - edge[:-2])
    window = 0.54 + 0.46 * np.cos(np.pi * (np.arange(2 * half) - half + 0.5) / half)
    frequencies = np.linspace(0.0, 1.0, 201)
    waves = np.exp(-2j * np.pi * np.outer(frequencies, middles))
    spectrum = np.abs(waves @ (line * window))
    derivative = np.sinc(2.0 * frequencies * _BIN_PX)
    averaging = np.sinc(frequencies * _BIN_PX)
    return frequencies, np.asarray(spectrum / spectrum[0] / derivative / averaging)

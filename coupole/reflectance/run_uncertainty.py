"""Uncertainty of the samples of a result of runs: typical bounds, and a table by source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.sample_sources import ChannelSamples, channel_samples
from coupole.reflectance.sample_uncertainty import SOURCES, MonteCarlo, Places, Sources, bounds

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

COVERAGE, QUANTILE = 0.95, 1.959964
TABLE_COVERAGE, TABLE_QUANTILE = 0.68, 0.994458
"""Coverage and quantile of the table, as in Lucat et al. 2025, 6.1."""
_TYPICAL = 200_000
"""Number of samples of all views from which the typical bounds are found."""
_TRIANGLES = 2000
"""Number of triangles of each view from which samples are taken."""
_LEDS = 128
"""Number of LEDs of each view from which samples are taken."""
_DRAWN, _DRAWS = 1000, 300
"""Number of samples, of all views, for Monte Carlo, and number of draws for each sample."""


def uncertainty_of(
    result: RunResult, scan_noise_um: float, *, paper: bool, say: Said = lambda step, done, of: None
) -> dict[str, Any] | None:
    """Return the entry of `result.json` about the uncertainty; None without a record of the response, which gives
    the noise."""
    most = _TYPICAL // len(result.views)
    channel_parts = [
        known_samples(result, view, result.channels // 2, scan_noise_um, most=most, of_triangles=_TRIANGLES)
        for view in result.views
    ]
    places = Places(*_join_fields([part.places for part in channel_parts]))
    sources = Sources(*_join_fields([part.sources for part in channel_parts]))
    if not len(sources.u_noise):
        return None
    random = np.random.default_rng(0)
    some = random.choice(len(sources.u_noise), min(_DRAWN, len(sources.u_noise)), replace=False)
    places_drawn, sources_drawn = places.at(some), sources.at(some)

    monte_carlo = MonteCarlo(places_drawn, _DRAWS, np.random.default_rng(1), paper=paper)

    def table(of: Sources) -> dict[str, Any]:
        ratios = monte_carlo.ratios(of)
        below, above = 0.5 - TABLE_COVERAGE / 2, 0.5 + TABLE_COVERAGE / 2
        return percentiles(*_quantiles(ratios, [below, above]))

    whole = table(sources_drawn)
    without = {}
    for number, (source, description) in enumerate(SOURCES.items(), start=1):
        say("uncertainty", number, len(SOURCES))
        if source == "u_glare" and not sources.u_glare.any():
            continue  # none was taken off
        without[description] = table(sources_drawn.without(source))
    return {
        "interval": percentiles(*bounds(places, sources, QUANTILE)) | {"coverage": COVERAGE},
        "closed_form": percentiles(*bounds(places_drawn, sources_drawn, TABLE_QUANTILE)),
        "monte_carlo": whole | {"coverage": TABLE_COVERAGE, "samples": len(some), "draws": _DRAWS},
        "without": without,
    }


def _quantiles(values: Floats, shares: list[float]) -> Floats:
    """[shares, n] quantiles of values [n, draws], without NaN. NumPy's `nanquantile` is slower, because it
    processes the rows one by one."""
    quantiles = np.asarray(np.quantile(values, shares, axis=1))
    has_unknown = np.isnan(values).any(axis=1)
    if has_unknown.any():
        quantiles[:, has_unknown] = np.nanquantile(values[has_unknown], shares, axis=1)
    return quantiles


def percentiles(low: Floats, high: Floats) -> dict[str, Any]:
    """Return median and 95th percentile of bounds, in percent. Infinite bounds are left out and counted; None if
    all are infinite."""
    is_finite = np.isfinite(high)
    if not is_finite.any():
        return {"median": None, "percentile_95": None, "unbounded_share": 1.0}
    below, above = 100.0 * (low[is_finite] - 1.0), 100.0 * (high[is_finite] - 1.0)
    return {
        "median": [float(np.median(below)), float(np.median(above))],
        "percentile_95": [float(np.quantile(below, 0.05)), float(np.quantile(above, 0.95))],
        "unbounded_share": float(1.0 - is_finite.mean()),
    }


def known_samples(
    result: RunResult, view: ViewSamples, channel: int, scan_noise_um: float, *, most: int, of_triangles: int
) -> ChannelSamples:
    """Return at most `most` samples that have a value. The samples are of about `of_triangles` triangles and of
    several LEDs, spread over the view.
    """
    rows = np.arange(0, len(view.triangles), max(1, len(view.triangles) // of_triangles))
    leds = np.arange(0, len(view.leds), -(-len(view.leds) // _LEDS))
    some = channel_samples(result, view, rows, leds, channel, scan_noise_um)
    places = some.known_places
    if len(places) > most:
        places = np.sort(np.random.default_rng(2).choice(places, most, replace=False))
    return some.at(places)


def _join_fields(parts: Sequence[Places] | Sequence[Sources]) -> list[Floats]:
    """Join the fields of all parts, one part after the other."""
    return [np.concatenate(values) for values in zip(*(vars(part).values() for part in parts), strict=True)]

"""Measured samples of a result of runs, which a page draws when a point is clicked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.look.look_blocks import Block, block_of, log_coded
from coupole.geometry import apply
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.sample_sources import channel_samples, triangles_beside
from coupole.reflectance.sample_uncertainty import bounds

ROWS = 64
"""Number of triangles in a block."""
_BAND, _LEDS = 4096, 8
"""Numbers of triangles and LEDs that are read together, as in the chunks of the file."""
_QUANTILE_95 = 1.959964
_FAR = 10.0
"""Value that is written for an unbounded end of an interval."""


def samples_of_result(
    result: RunResult,
    support_from_base: NDArray[np.float64],
    scan_noise_um: float,
    say: Callable[[str, int, int], None],
) -> tuple[list[dict[str, Any]], list[Block]]:
    """Return the page's facts of the samples of all views, and their blocks."""
    view_facts, blocks = [], []
    for view in result.views:
        of_view, view_blocks = samples_of_view(result, view, support_from_base, scan_noise_um, say)
        view_facts.append(of_view)
        blocks += view_blocks
    return view_facts, blocks


def samples_of_view(
    result: RunResult,
    view: ViewSamples,
    support_from_base: NDArray[np.float64],
    scan_noise_um: float,
    say: Callable[[str, int, int], None],
) -> tuple[dict[str, Any], list[Block]]:
    """Return the page's facts of a view's samples, and its blocks.

    The blocks are numbers of triangles, places of LEDs, and codes [3, ROWS, leds] for each `ROWS` triangles. The
    codes are the channels' mean f cos_i, and how far the ends of its 95 % interval are below and above it, as
    shares of it. The interval includes all sources, with the errors of all channels in the same direction.

    Raises InputError for samples of an earlier version.
    """
    name, count = view.path.stem, len(view.triangles)
    blocks = [
        block_of(f"samples-{name}-triangles", view.triangles.astype(np.uint32)),
        block_of(f"samples-{name}-leds", apply(support_from_base, view.led_mm).astype(np.float32)),
    ]
    for first in range(0, count, _BAND):
        rows = np.arange(first, min(first + _BAND, count))
        codes = _codes(result, view, rows, scan_noise_um)
        blocks += [
            block_of(f"samples-{name}-{(first + at) // ROWS}", codes[:, at : at + ROWS])
            for at in range(0, len(rows), ROWS)
        ]
        say(f"samples of {view.view}", int(rows[-1]) + 1, count)
    camera_mm = apply(support_from_base, view.camera_mm).tolist()
    return {"view": view.view, "name": name, "rows": ROWS, "camera_mm": camera_mm}, blocks


def _codes(
    result: RunResult, view: ViewSamples, rows: NDArray[np.int64], scan_noise_um: float
) -> NDArray[np.uint8]:
    """[3, rows, leds] codes of these triangles."""
    beside = triangles_beside(result, view, rows)
    mean = result.view_samples(view, slice(int(rows[0]), int(rows[-1]) + 1)).values.mean(axis=2, dtype=np.float64)
    codes = np.zeros((3, len(rows), len(view.leds)), np.uint8)
    codes[0] = log_coded(np.where(mean > 0.0, mean, np.nan))
    for first in range(0, len(view.leds), _LEDS):
        leds = np.arange(first, min(first + _LEDS, len(view.leds)))
        samples = channel_samples(result, view, rows, leds, None, scan_noise_um, beside)
        finite_samples = samples.at(samples.known_places)
        low, high = bounds(finite_samples.places, finite_samples.sources, _QUANTILE_95)
        ends = np.full((2, len(samples.f)), np.nan)
        ends[:, samples.known_places] = 1.0 - low, np.minimum(high - 1.0, _FAR)
        codes[1:, :, leds] = log_coded(ends).reshape(2, len(rows), len(leds))
    return codes

"""Measured samples of a result of runs, for a page to draw when a point is clicked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.look.look_blocks import Block, block_of, log_coded
from coupole.geometry import apply
from coupole.reflectance.run_result import RunResult, ViewSamples

ROWS = 64
"""Triangles of a block."""


def samples_of_view(
    result: RunResult,
    view: ViewSamples,
    support_from_base: NDArray[np.float64],
    say: Callable[[str, int, int], None],
) -> tuple[dict[str, Any], list[Block]]:
    """What the page knows of a view's samples, and its blocks: the numbers of triangles, and of `ROWS` of them
    [2, ROWS, leds] codes of the channels' mean f cos_i and of its relative standard uncertainty at most: by what
    `view_noise` has, as if all channels were off to the same side, as they are by an LED's power."""
    name, count = view.path.stem, len(view.triangles)
    leds = np.ones(len(view.leds), bool)
    blocks = [
        block_of(f"samples-{name}-triangles", view.triangles.astype(np.uint32)),
        block_of(f"samples-{name}-leds", apply(support_from_base, view.led_mm).astype(np.float32)),
    ]
    for first in range(0, count, ROWS):
        rows = slice(first, min(first + ROWS, count))
        values = result.view_samples(view, rows).values.astype(np.float64)
        u = result.view_noise(view, rows, leds)
        known = np.isfinite(values).all(axis=2)
        mean = np.where(known, values.mean(axis=2), np.nan)
        own = np.mean(np.abs(values) * u, axis=2) / np.maximum(np.abs(mean), 1e-12)
        codes = np.stack([log_coded(np.where(mean > 0.0, mean, np.nan)), log_coded(own)])
        blocks.append(block_of(f"samples-{name}-{first // ROWS}", codes))
        say(f"samples of {view.view}", rows.stop, count)
    camera_mm = apply(support_from_base, view.camera_mm).tolist()
    return {"view": view.view, "name": name, "rows": ROWS, "camera_mm": camera_mm}, blocks

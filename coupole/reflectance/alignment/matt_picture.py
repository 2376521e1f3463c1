"""A picture of each view in which a place of the surface looks the same from everywhere.

Object and LEDs stand still while the camera goes round, so a matt surface has the same radiance in all views under
the same LED, whatever its shape, its shadows and the LEDs' power are. What differs is gloss, which makes some LEDs
brighter than the rest, and the arm's shadow, which makes some darker. So a picture is the mean of the middle ranks
of the same LEDs in all views: no mesh is needed for it, and errors of the mesh cannot get into it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import Radiometry

MOST_LEDS = 24
FEWEST_LEDS = 5
LOW_RANK, HIGH_RANK = 0.2, 0.6
"""Ranks of an LED's brightness at a place, 0 for the darkest, between which the mean is taken."""
GREEN = "G"
Said = Callable[[str, int, int], None]


def common_leds(views: Sequence[MeasuredView]) -> list[int]:
    """LEDs under which all views were taken, thinned out evenly to `MOST_LEDS`. Raises InputError for fewer than
    `FEWEST_LEDS`."""
    common = sorted(set.intersection(*(set(view.by_led) for view in views)))
    if len(common) < FEWEST_LEDS:
        raise InputError(
            f"views are compared under the same LEDs: expected {FEWEST_LEDS} or more that all views have, found "
            f"{len(common)}; name runs that share more"
        )
    places = np.linspace(0, len(common) - 1, min(len(common), MOST_LEDS)).round().astype(int)
    return [common[place] for place in places]


def matt_picture(
    measured: MeasuredRun, radiometry: Radiometry, view: MeasuredView, leds: Sequence[int], say: Said
) -> NDArray[np.float32]:
    """[h / 2, w / 2] mean of green DN per microsecond over the flat field, of blocks of 2 x 2 pixels. Raises
    StorageError for a damaged frame."""
    green = radiometry.channel == measured.channels.index(GREEN)
    height, width = green.shape
    stack = np.empty((len(leds), height // 2, width // 2), np.float32)
    for number, led in enumerate(leds):
        frame = max(view.by_led[led], key=lambda one: one.exposure_us)
        _green_blocks(frame.read(), radiometry.dark(frame), radiometry.flat, green, stack[number])
        stack[number] /= frame.exposure_us
        say(f"picture of {view.name}", number + 1, len(leds))
    low, high = int(LOW_RANK * len(leds)), max(int(HIGH_RANK * len(leds)), int(LOW_RANK * len(leds)) + 1)
    stack.partition((low, high - 1), axis=0)
    return np.asarray(stack[low:high].mean(axis=0), np.float32)


@numba.njit(cache=True, nogil=True)
def _green_blocks(raw, dark, flat, green, means):  # type: ignore[no-untyped-def]
    """Into `means` [h / 2, w / 2]: the two greens of a block lie evenly about its middle."""
    for row in range(means.shape[0]):
        for column in range(means.shape[1]):
            total, count = 0.0, 0
            for pixel in range(4):
                y, x = 2 * row + pixel // 2, 2 * column + pixel % 2
                if green[y, x]:
                    total += (float(raw[y, x]) - dark[y, x]) / flat[y, x]
                    count += 1
            means[row, column] = total / count

"""Makes one picture for each view; a place of the surface looks the same in the pictures of all views.

Object and LEDs stand still while the camera goes round. So a matt surface has the same radiance in all views under
the same LED, whatever its shape, its shadows and the LEDs' power are. Only gloss and the arm's shadow differ:
gloss makes some LEDs brighter than the rest, and the shadow makes some darker. So the picture is the mean of the
middle ranks of the same LEDs in all views. It needs no mesh, and errors of the mesh do not affect it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels import kernel
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import RANGE_LEFT_OUT, Radiometry

MOST_LEDS = 24
FEWEST_LEDS = 5
LOW_RANK, HIGH_RANK = 0.2, 0.6
"""The mean is taken between these ranks of the LEDs' brightness at a place; 0 is the rank of the darkest LED."""
ALL_BUT = 1e-3
"""Share of a picture's blocks that may be clipped before a shorter exposure is used."""
GREEN = "G"
Said = Callable[[str, int, int], None]


def common_leds(views: Sequence[MeasuredView]) -> list[int]:
    """LEDs under which all views were taken, thinned out evenly to `MOST_LEDS`. Raises InputError for fewer than
    `FEWEST_LEDS`."""
    common = sorted(set.intersection(*(set(view.by_led) for view in views)))
    if len(common) < FEWEST_LEDS:
        raise InputError(
            f"views are compared under the same LEDs: expected {FEWEST_LEDS} or more LEDs that all views have, "
            f"found {len(common)}; name runs that share more LEDs"
        )
    places = np.linspace(0, len(common) - 1, min(len(common), MOST_LEDS)).round().astype(int)
    return [common[place] for place in places]


def matt_picture(
    measured_run: MeasuredRun, radiometry: Radiometry, view: MeasuredView, leds: Sequence[int], say: Said
) -> NDArray[np.float32]:
    """[h / 2, w / 2] mean of green DN per microsecond over the flat field, in blocks of 2 x 2 pixels. Each block
    is from the longest exposure that does not clip it. If all exposures of an LED clip a block, the block counts
    as brighter than under the other LEDs. The mean is NaN if such LEDs are among the ranks that are used. Raises
    StorageError for a damaged frame."""
    green = radiometry.channel == measured_run.channels.index(GREEN)
    height, width = green.shape
    stack = np.full((len(leds), height // 2, width // 2), np.inf, np.float32)
    top_dn = radiometry.white_dn - RANGE_LEFT_OUT * (radiometry.white_dn - radiometry.black_dn)
    for number, led in enumerate(leds):
        for frame in sorted(view.by_led[led], key=lambda one: -one.exposure_us):
            dark, means = radiometry.dark(frame), stack[number]
            _green_blocks(frame.read(), dark, radiometry.flat, green, top_dn, frame.exposure_us, means)
            if np.mean(np.isinf(means)) <= ALL_BUT:
                break
        say(f"picture of {view.name}", number + 1, len(leds))
    low, high = int(LOW_RANK * len(leds)), max(int(HIGH_RANK * len(leds)), int(LOW_RANK * len(leds)) + 1)
    stack.partition((low, high - 1), axis=0)
    mean = stack[low:high].mean(axis=0)
    return np.asarray(np.where(np.isfinite(mean), mean, np.nan), np.float32)


@kernel
def _green_blocks(raw, dark, flat, green, top_dn, exposure_us, means):  # type: ignore[no-untyped-def]
    """Fill `means` [h / 2, w / 2] with the green signal of blocks, where `means` is infinite and the frame is
    below `top_dn`. The two green pixels of a block lie symmetrically about its middle."""
    for row in range(means.shape[0]):
        for column in range(means.shape[1]):
            if not np.isinf(means[row, column]):
                continue
            total, count, any_clipped = 0.0, 0, False
            for pixel in range(4):
                y, x = 2 * row + pixel // 2, 2 * column + pixel % 2
                if green[y, x]:
                    total += (float(raw[y, x]) - dark[y, x]) / flat[y, x]
                    count += 1
                    any_clipped |= raw[y, x] >= top_dn
            if not any_clipped:
                means[row, column] = total / (count * exposure_us)

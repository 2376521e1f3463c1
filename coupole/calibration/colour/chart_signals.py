"""Signals of a chart's patches: means over the pixels of each patch in a picture, then one value from many lights.

On a matt chart each light k gives the patch p the signal s = g_k E_kp b_p. Here E is the light's irradiance at the
patch, which is known or comes from a white sheet in the chart's place. g is the light's own strength. Medians over
patches and lights give g and b. If a patch departs from them under a light, it is in shadow or glossy there, and
is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

COLOUR, MONO = "COLOUR", "MONO"
_LEAST_PIXELS = 12
"""Least number of pixels of each colour on a patch."""
_ODD, _ODD_SIGMA = 0.03, 6.0
"""Departure of a patch under one light above which it counts as shadow or gloss: relative, and in units of
noise."""
_LEAST_LIGHTS = 3
"""Least number of lights that is needed to find shadows."""
_ROUNDS = 5


@dataclass(frozen=True)
class ChartPicture:
    """One picture of the chart, with its light and the places of patches and edges."""

    name: str
    signal: Floats
    """[H, W] signal above dark, linear, over the flat field; for the pattern `COLOUR` it is [H, W, 3]."""
    full: NDArray[np.bool_]
    """True where a pixel is saturated; it has the shape of `signal`."""
    pattern: str
    """Names of the four pixels at the top left, row by row; or `COLOUR`."""
    patches_px: Floats
    """[patches, 4, 2] x, y of the corners."""
    edges_px: Floats
    """[edges, 4, 2]."""
    light: Floats
    """[patches] irradiance in any unit. It is 1 if the light is assumed to be uniform."""


@dataclass(frozen=True)
class Reading:
    """The patches in one picture."""

    mean: Floats
    """[patches, 3] red, green, blue."""
    u: Floats
    """[patches, 3] uncertainty of the means from noise."""
    pixel_sd: Floats
    """[patches, 3] standard deviation of single pixels."""
    full: NDArray[np.bool_]
    """[patches]."""


@dataclass(frozen=True)
class Signals:
    """The patches under all lights."""

    mean: Floats
    """[patches, 3] means under uniform light."""
    u: Floats
    """[patches, 3] standard uncertainty, from noise and from the disagreement of the lights."""
    pixel_sd: Floats
    """[patches, 3] relative standard deviation of single pixels, as the median over the lights."""
    remarks: tuple[str, ...]


def samples_of(
    picture: ChartPicture, channel: str, inside: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> NDArray[np.intp]:
    """Return the numbers [k] of those pixels (rows, columns) that have a channel."""
    if picture.pattern == COLOUR:
        return np.arange(len(inside[0]))
    letters = np.array(list(picture.pattern)).reshape(2, 2)
    return np.flatnonzero(letters[inside[0] % 2, inside[1] % 2] == channel)


def values_at(
    picture: ChartPicture, channel: int, inside: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return signals and saturation [k] of pixels (rows, columns)."""
    at = (*inside, channel) if picture.pattern == COLOUR else inside
    return picture.signal[at], picture.full[at]


def pixels_inside(polygon: Floats, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return rows and columns of the pixels inside a convex polygon [4, 2]; None if the polygon is partly outside
    the picture."""
    if (polygon < 0).any() or (polygon > np.array([shape[1], shape[0]]) - 1).any():
        return None
    low, high = np.floor(polygon.min(axis=0)).astype(int), np.ceil(polygon.max(axis=0)).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    away = np.stack([columns, rows], axis=-1)[:, :, None] - polygon
    along = np.roll(polygon, -1, axis=0) - polygon
    side = along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0]
    inside = (side >= 0).all(axis=-1) | (side <= 0).all(axis=-1)
    return rows[inside], columns[inside]


def read_patches(picture: ChartPicture, names: Sequence[str]) -> Reading:
    """Return means of all patches. Raises InputError for patches outside the picture, or too small in it."""
    if picture.pattern == MONO:
        raise InputError(f"{picture.name}: the camera has one channel, so it has no colours")
    count = len(names)
    mean, u, sd = (np.empty((count, 3)) for _ in range(3))
    full = np.zeros(count, np.bool_)
    patch_pixels = [pixels_inside(polygon, picture.signal.shape) for polygon in picture.patches_px]
    if outside := [name for name, inside in zip(names, patch_pixels, strict=True) if inside is None]:
        raise InputError(
            f"{picture.name}: outside the picture are the patches {_list(outside)}; correct the chart's place, or "
            "name its corners with --corners"
        )
    for p, inside in enumerate(patch_pixels):
        assert inside is not None
        for c, channel in enumerate("RGB"):
            take = samples_of(picture, channel, inside)
            if len(take) < _LEAST_PIXELS:
                raise InputError(
                    f"{picture.name}: the patch {names[p]} has {len(take)} pixels of {channel}, expected "
                    f"{_LEAST_PIXELS} or more; go nearer"
                )
            values, is_saturated = values_at(picture, c, (inside[0][take], inside[1][take]))
            mean[p, c], sd[p, c] = values.mean(), values.std(ddof=1)
            u[p, c] = sd[p, c] / np.sqrt(len(values))
            full[p] |= bool(is_saturated.any())
    return Reading(mean, u, sd, full)


def combined_signals(
    names: Sequence[str],
    readings: Sequence[Reading],
    lights: Floats,
    lit: Sequence[str],
    *,
    are_pictures: bool = False,
) -> Signals:
    """Return one signal for each patch, from its readings under all lights.

    `lights` [lights, patches] or [lights, patches, 3] are irradiances, and `lit` are the lights' names. With
    `are_pictures`, each reading is a picture, and the caller reports the saturated patches. Raises InputError with
    the names of patches that are dark, or that are saturated or in shadow under more than half of the lights.
    """
    light = lights if lights.ndim == 3 else lights[:, :, None]
    mean, u = (np.stack([getattr(reading, field) for reading in readings]) / light for field in ("mean", "u"))
    sd = np.stack([reading.pixel_sd / np.maximum(reading.mean, 1e-300) for reading in readings])
    good = ~np.stack([reading.full for reading in readings])
    bright = [n for n in range(len(names)) if 2 * good[:, n].sum() < len(good)]
    _refuse(bright, names, "saturated under most lights", "expose less")
    dark = ~(np.nanmedian(np.where(good[:, :, None], mean, np.nan), axis=0) > 0.0).all(axis=1)
    unlit = [int(n) for n in np.flatnonzero(dark)]
    _refuse(unlit, names, "without light", "check the lights and the chart's place")
    remarks = []
    full = [f"{lit[k]} on {_list([names[int(n)] for n in np.flatnonzero(~good[k])])}" for k in _with(~good)]
    if full and not are_pictures:
        remarks.append(f"saturated, and left out: {_list(full)}")
    strength, patch = _split(mean, good)
    if len(readings) >= _LEAST_LIGHTS:
        expected_signal = strength[:, None] * patch
        noise = u / expected_signal
        odd = (np.abs(mean / expected_signal - 1.0) > np.maximum(_ODD, _ODD_SIGMA * noise)).any(axis=2) & good
        few = [n for n in range(len(names)) if 2 * odd[:, n].sum() > good[:, n].sum()]
        _refuse(few, names, "in shadow, or glossy, under most lights", "free the light's way to the chart")
        if odd_patches := [
            f"{lit[k]} on {_list([names[int(n)] for n in np.flatnonzero(odd[k])])}" for k in _with(odd)
        ]:
            remarks.append(f"in shadow or glossy, and left out: {_list(odd_patches)}")
        good &= ~odd
        strength, patch = _split(mean, good)
    else:
        sources = "pictures" if are_pictures else "lights"
        remarks.append(f"fewer than three {sources}: shadows and gloss on the chart cannot be detected")
    return _averaged_signals(mean / strength[:, None], u / strength[:, None], sd, good, tuple(remarks))


def _split(mean: Floats, good: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return strengths [lights, 3], with a mean of 1, and patches [patches, 3]. Their products are the signals.
    They are found by medians."""
    good_mean = np.where(good[:, :, None], mean, np.nan)
    patch = np.nanmedian(good_mean, axis=0)
    strength = np.ones((len(mean), mean.shape[2]))
    for _ in range(_ROUNDS):
        usable = [k for k in range(len(mean)) if good[k].any()]
        strength[usable] = np.nanmedian(good_mean[usable] / patch, axis=1)
        strength /= strength[usable].mean(axis=0)
        patch = np.nanmedian(good_mean / strength[:, None], axis=0)
    return strength, patch


def _averaged_signals(
    mean: Floats, u: Floats, sd: Floats, good: NDArray[np.bool_], remarks: tuple[str, ...]
) -> Signals:
    """Return means over the lights. Their uncertainty is the larger of noise and scatter."""
    count = good.sum(axis=0)[:, None]
    good_mean = np.where(good[:, :, None], mean, np.nan)
    average = np.nanmean(good_mean, axis=0)
    noise = np.sqrt((np.where(good[:, :, None], u, 0.0) ** 2).sum(axis=0)) / count
    scatter = np.sqrt(np.nansum((good_mean - average) ** 2, axis=0) / np.maximum(count - 1, 1) / count)
    typical = np.nanmedian(np.where(good[:, :, None], sd, np.nan), axis=0)
    return Signals(average, np.maximum(noise, scatter), typical, remarks)


def _with(marks: NDArray[np.bool_]) -> list[int]:
    return [int(k) for k in np.flatnonzero(marks.any(axis=1))]


def _refuse(numbers: Sequence[int], names: Sequence[str], fault: str, remedy: str) -> None:
    if len(numbers):
        raise InputError(
            f"colour: {fault}: the patches {_list([names[n] for n in numbers])}; {remedy}, or leave them out with "
            "--without"
        )


def _list(words: Sequence[str]) -> str:
    return ", ".join(words[:8]) + (f" and {len(words) - 8} more" if len(words) > 8 else "")

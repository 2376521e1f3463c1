"""The CMOS sensor: from radiance to digital numbers.

Electrons: light after Bayer filter and each pixel's response (PRNU), ambient light, dark current with hot pixels;
shot noise (Poisson); full well. Then the readout: offset (DSNU), row noise, read noise; gain; black level;
rounding and clipping by the ADC. The terms are those of EMVA 1288.

A frame is a function of the model, the light and its number: the same seed gives the same frame, bit by bit,
whatever the number of threads. `fixed_pattern` and the model's values are the truth for tests of calibrations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels import kernel
from sim.optics import noise
from sim.optics.sensor_model import SensorModel

_RESPONSE, _DARK, _PIXELS, _ROWS = range(4)
"""Kinds of noise derived from one seed."""
_BLOCK = 4
"""Side of the blocks of pixels in which sites are numbered (`sim.render.pixel_sites`)."""


@dataclass(frozen=True)
class FixedPattern:
    """Properties of the individual pixels, the same in every frame; arrays are [h, w] and read-only."""

    response: NDArray[np.float32]
    """Relative to the mean pixel (PRNU)."""
    offset_e: NDArray[np.float32]
    """DSNU."""
    dark_e_per_s: NDArray[np.float32]
    """Dark current at the model's reference temperature, hot pixels included."""
    hot: NDArray[np.bool_]


@lru_cache(maxsize=2)
def fixed_pattern(model: SensorModel, height_px: int, width_px: int) -> FixedPattern:
    """The sensor's fixed pattern: a function of the seed and the pixel's coordinates."""
    shape = (height_px, width_px)
    response, offset_e, dark = (np.empty(shape, np.float32) for _ in range(3))
    hot = np.empty(shape, np.bool_)
    figures = np.array(
        [model.prnu, model.dsnu_e, model.dark_e_per_s, model.dark_spread, model.hot_share, model.hot_factor]
    )
    keys = (noise.key(model.seed, _RESPONSE), noise.key(model.seed, _DARK))
    _fill_pattern(response, offset_e, dark, hot, figures, *keys, noise.INVERSE_NORMAL)
    for table in (response, offset_e, dark, hot):
        table.flags.writeable = False
    return FixedPattern(response, offset_e, dark, hot)


def mosaic_electrons(
    site: NDArray[np.int32],
    radiance: NDArray[np.float32],
    falloff: NDArray[np.float32],
    *,
    model: SensorModel,
    electrons_per_radiance: float,
) -> NDArray[np.float32]:
    """[h, w] mean electrons at every pixel, in its own channel.

    `site` [h k, w k] holds, for k x k samples of each pixel, a row of `radiance` [sites, 3], or -1 for nothing;
    the pixel takes their mean. Radiance times `falloff` [h, w] times `electrons_per_radiance` is the mean number
    of electrons of a pixel with response 1.

    Raises:
        InputError: The shapes do not fit together.
    """
    height, width = falloff.shape
    k = site.shape[0] // height
    if k < 1 or site.shape != (height * k, width * k):
        raise InputError(
            f"sensor: expected sites for k x k samples of each of the {falloff.shape} pixels of the fall-off; "
            f"found {site.shape}; render for the camera's size"
        )
    mean_e = np.empty(falloff.shape, np.float32)
    _collect(mean_e, site, radiance, falloff, model.channels(), electrons_per_radiance)
    return mean_e


def electrons(
    site: NDArray[np.int32],
    radiance: NDArray[np.float32],
    falloff: NDArray[np.float32],
    *,
    electrons_per_radiance: float,
) -> NDArray[np.float32]:
    """[h, w, 3] mean electrons in all three channels at every pixel, for stages before the Bayer filter, such as
    the lens's blur. Arguments as in `mosaic_electrons`."""
    mean_e = np.empty((*falloff.shape, 3), np.float32)
    _collect_all(mean_e, site, radiance, falloff, electrons_per_radiance)
    return mean_e


def expose_electrons(
    out: NDArray[np.uint16],
    mean_e: NDArray[np.float32],
    *,
    model: SensorModel,
    frame: int,
    exposure_s: float = 0.0,
    gain: float = 1.0,
    temperature_c: float = 25.0,
) -> None:
    """Fill `out` [h, w] with one frame, DN, from the mean electrons [h, w] of light in pixels of response 1.

    `exposure_s` and `temperature_c` set dark current and ambient light; `gain` divides the electrons per DN.

    Raises:
        InputError: The shapes differ.
    """
    if mean_e.shape != out.shape:
        raise InputError(
            f"sensor: expected mean electrons of {out.shape}, found {mean_e.shape}; render for the camera's size"
        )
    _develop(out, mean_e, *_settings(model, out.shape, frame, exposure_s, gain, temperature_c))


def _settings(
    model: SensorModel, shape: tuple[int, ...], frame: int, exposure_s: float, gain: float, temperature_c: float
) -> tuple[Any, ...]:
    """Arguments of `_develop` other than the light: fixed pattern, ambient light, readout, frame, keys, tables."""
    pattern = fixed_pattern(model, *shape)
    ambient_e = np.asarray(model.ambient_e_per_s, np.float32)[model.channels()] * np.float32(exposure_s)
    dn_per_e = gain / model.electrons_per_dn
    dark_s = exposure_s * model.dark_factor(temperature_c)
    well, read_e, row = model.full_well_e, model.read_noise_e, model.row_noise_e
    readout = np.array([dark_s, well, read_e, row, dn_per_e, model.black_dn, model.white_dn], np.float32)
    return (
        pattern.response,
        pattern.offset_e,
        pattern.dark_e_per_s,
        ambient_e,
        readout,
        np.uint32(frame % 2**32),
        noise.key(model.seed, _PIXELS),
        noise.key(model.seed, _ROWS),
        noise.INVERSE_NORMAL,
        noise.SMALL_MEANS,
        noise.SMALL_STARTS,
    )


@kernel(parallel=True)
def _fill_pattern(response, offset_e, dark, hot, figures, response_key, dark_key, table):  # type: ignore[no-untyped-def]
    height, width = response.shape
    prnu, dsnu_e, dark_median, dark_spread, hot_share, hot_factor = figures
    for row in numba.prange(height):
        for col in range(width):
            first, second = noise.philox(col, row, response_key)
            response[row, col] = 1.0 + prnu * noise.normal(first, table)
            offset_e[row, col] = dsnu_e * noise.normal(second, table)
            first, second = noise.philox(col, row, dark_key)
            hot[row, col] = np.float64(second) < hot_share * 2.0**32
            rate = dark_median * np.exp(dark_spread * noise.normal(first, table))
            dark[row, col] = rate * hot_factor if hot[row, col] else rate


@kernel(parallel=True)
def _collect(mean_e, site, radiance, falloff, channels, electrons):  # type: ignore[no-untyped-def]
    height, width = mean_e.shape
    k = len(site) // height
    share = np.float32(electrons / (k * k))
    for row in numba.prange(height):
        for col in range(width):
            channel = channels[row & 1, col & 1]
            total = np.float32(0.0)
            if k == 1:
                if site[row, col] >= 0:
                    total = radiance[site[row, col], channel]
            else:
                for y in range(row * k, row * k + k):
                    for x in range(col * k, col * k + k):
                        if site[y, x] >= 0:
                            total += radiance[site[y, x], channel]
            mean_e[row, col] = total * falloff[row, col] * share


@kernel(parallel=True)
def _collect_all(mean_e, site, radiance, falloff, electrons):  # type: ignore[no-untyped-def]
    height, width, _ = mean_e.shape
    k = len(site) // height
    share = np.float32(electrons / (k * k))
    # The loop goes over blocks, in the order of the sites' numbers, so that each site is read while it is in the
    # cache.
    for band in numba.prange(-(-height // _BLOCK)):
        for block in range(0, width, _BLOCK):
            for row in range(band * _BLOCK, min(height, (band + 1) * _BLOCK)):
                for col in range(block, min(width, block + _BLOCK)):
                    red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                    for part in range(k * k):
                        place = site[row * k + part // k, col * k + part % k]
                        if place >= 0:
                            red, green = red + radiance[place, 0], green + radiance[place, 1]
                            blue += radiance[place, 2]
                    scale = falloff[row, col] * share
                    mean_e[row, col, 0], mean_e[row, col, 1] = red * scale, green * scale
                    mean_e[row, col, 2] = blue * scale


@kernel(parallel=True)
def _develop(  # type: ignore[no-untyped-def]
    out,
    light_e,
    response,
    offset_e,
    dark,
    ambient_e,
    readout,
    frame,
    pixel_key,
    row_key,
    inverse_normal,
    small_means,
    small_starts,
):
    """Apply shot noise, full well, readout and ADC. The loops over a row are separate, so that all but the loop of
    the dim pixels are vectorised. Arrays in tuples would halve the speed."""
    height, width = out.shape
    dark_s, full_well, read_e, row_e, dn_per_e, black, white = readout
    for row in numba.prange(height):
        mean, count, read_noise = (
            np.empty(width, np.float32),
            np.empty(width, np.float32),
            np.empty(width, np.float32),
        )
        shot_word = np.empty(width, np.uint32)
        row_word, _ = noise.philox(row, frame, row_key)
        common = row_e * noise.normal(row_word, inverse_normal)
        for col in range(width):
            light = light_e[row, col] + ambient_e[row & 1, col & 1]
            mean[col] = light * response[row, col] + dark[row, col] * dark_s
        for col in range(width):
            pixel = np.uint32(row) * np.uint32(width) + np.uint32(col)
            shot_word[col], second = noise.philox(pixel, frame, pixel_key)
            read_noise[col] = read_e * noise.normal(second, inverse_normal) + offset_e[row, col] + common
            bright = max(mean[col], np.float32(noise.POISSON_EXACT_BELOW))
            count[col] = noise.poisson_quantile(bright, noise.normal(shot_word[col], inverse_normal))
        for col in range(width):
            if mean[col] < np.float32(noise.POISSON_EXACT_BELOW):
                count[col] = noise.poisson_exact(mean[col], shot_word[col], small_means, small_starts)
        for col in range(width):
            dn = black + (min(count[col], full_well) + read_noise[col]) * dn_per_e + np.float32(0.5)
            out[row, col] = np.uint16(min(max(dn, np.float32(0.0)), white))

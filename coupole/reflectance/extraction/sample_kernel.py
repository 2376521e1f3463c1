"""Samples of reflectance from the pixels of up to eight frames at once, in compiled code.

The lists of pixels are read once for eight frames; the sums of the frames are the lanes of a vector. Single
precision is enough: its directions are exact to 1e-7, and float16 has steps of 5e-4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.lanes import (
    absolute,
    gather_lanes,
    if_less,
    lanes,
    larger,
    load_row,
    root,
    store_halves,
)
from coupole.reflectance.extraction.frame_veils import NO_VEILS, Veils
from coupole.reflectance.extraction.sample_codes import REACHED

Singles = NDArray[np.float32]

MOST_F = 6e4
"""Largest value, 1/sr: float16 ends at 65504."""
NO_VALUE = 0x7E00
"""NaN as the bits of a float16."""
_NAN = np.float32(np.nan)
_SQUARE_MM = np.float32(1e6 / np.pi)


class Shots(NamedTuple):
    """Frames of up to eight LEDs, one lane for each LED, in passes. A pass has one frame of each LED, all with one
    exposure."""

    frames: NDArray[np.uint16]
    """[slots, memory of a frame]"""
    slots: NDArray[np.int64]
    """[passes, 8]"""
    there: NDArray[np.uint8]
    """[passes, 8] 1 where there is a frame; else the slot means nothing."""
    times_s: Singles
    """[passes] exposures."""
    exposures: NDArray[np.int64]
    """[passes] rows of the dark signals for these exposures."""
    veils: Veils = NO_VEILS
    """Glare in the frames of these LEDs."""


class Lamps(NamedTuple):
    """The LEDs of the eight lanes."""

    centres_mm: Singles
    """[3, 8]"""
    axes: Singles
    """[3, 8]"""
    powers: Singles
    """[channels, 8] DN s^-1 m^2 sr; NaN where there is none."""
    paper: bool
    """True if the emitter's cosine counts twice (Lucat et al. 2025, Eq. 2)."""


@kernel(error_model="numpy")
def fill_samples(first, lists, response, darks, shots, lamps, centres_mm, normals, codes, f, u_own, glare):  # type: ignore[no-untyped-def]
    """Fill `f` and `u_own` [b, leds, channels], bits of float16, with the samples of b triangles from the `first`
    on, where `codes` [b, 8] say that light has reached them. Fill `glare` [b, leds, channels], which may be empty,
    with the subtracted veil over the remaining signal. `lists` are the view's PixelLists, `darks` [exposures,
    pixels] the DN of its frames without light, `response` the camera's response."""
    bits = np.empty((3, 8), np.uint16)
    for row in range(len(f)):
        if REACHED not in codes[row]:
            continue
        per_irradiance = _per_irradiance(centres_mm[row], normals[row], lamps)
        off = absolute(load_row(codes, row) - np.float32(REACHED))
        per_irradiance = if_less(off, np.float32(0.5), per_irradiance, _NAN)
        for channel in range(f.shape[2]):
            list_number = (first + row) * f.shape[2] + channel
            begin, end = lists.starts[list_number], lists.starts[list_number + 1]
            signal, u_signal, veil = _signal(begin, end, channel, lists, response, darks, shots)
            value = signal * per_irradiance / load_row(lamps.powers, channel)
            size = absolute(value)
            store_halves(if_less(size, np.float32(MOST_F), value, _NAN), bits[0])
            store_halves(if_less(size, np.float32(MOST_F), u_signal, _NAN), bits[1])
            for led in range(f.shape[1]):
                f[row, led, channel], u_own[row, led, channel] = bits[0, led], bits[1, led]
            if len(glare):
                share = veil / absolute(signal)
                share = if_less(share, np.float32(MOST_F), share, np.float32(MOST_F))
                store_halves(if_less(size, np.float32(MOST_F), share, _NAN), bits[2])
                for led in range(f.shape[1]):
                    glare[row, led, channel] = bits[2, led]


@kernel(error_model="numpy")
def fill_pixels(  # type: ignore[no-untyped-def]
    first_entry, entry_ends, lists, response, darks, shots, lamps, places_mm, codes, direct, values, root_share
):
    """Fill `values` [pixels, leds], bits of float16, with S / (P E/Phi) of single pixels, 1/sr. This is f times
    the cosine of incidence, whatever the normal is. Noise lowers the mean of their square roots; the share
    `root_share` (float32) of this loss is added.

    The pixels are those of the lists from the `first_entry` on, up to `entry_ends` [b, channels] of each of b
    triangles. `places_mm` [pixels, 3] are the places that they see, and `codes` [b, 8] say where light has
    reached the triangle. `direct` [b, leds, channels] is the share of a triangle's light that came directly from
    the LED. For the other arguments see `fill_samples`.
    """
    bits, straight = np.empty(8, np.uint16), np.empty((1, 8), np.float32)
    pixel = first_entry
    for row in range(len(codes)):
        for channel in range(entry_ends.shape[1]):
            end = entry_ends[row, channel]
            if REACHED not in codes[row]:
                pixel = end
                continue
            off = absolute(load_row(codes, row) - np.float32(REACHED))
            for led in range(values.shape[1]):
                straight[0, led] = direct[row, led, channel]
            share = if_less(off, np.float32(0.5), load_row(straight, 0), _NAN) / load_row(lamps.powers, channel)
            while pixel < end:
                signal, u_signal, _ = _signal(pixel, pixel + 1, channel, lists, response, darks, shots)
                signal = signal + absolute(signal) * _lost_by_root(u_signal) * root_share
                value = signal * share * _per_normal_irradiance(places_mm[pixel - first_entry], lamps)
                store_halves(if_less(absolute(value), np.float32(MOST_F), value, _NAN), bits)
                for led in range(values.shape[1]):
                    values[pixel - first_entry, led] = bits[led]
                pixel += 1


@kernel(error_model="numpy")
def _lost_by_root(u_signal):  # type: ignore[no-untyped-def]
    """Return the share of a signal that must be added because noise lowers the mean of its square root. It is u^2
    / 4 to second order, and less if noise is as large as the signal; 0 if noise is not known."""
    half, none = np.float32(0.5), np.float32(0.0)
    smaller = if_less(u_signal, half, u_signal * u_signal, half * u_signal)
    return np.float32(0.25) * if_less(u_signal, np.float32(1e6), smaller, none)


@kernel(error_model="numpy")
def _per_normal_irradiance(place_mm, lamps):  # type: ignore[no-untyped-def]
    """Return 1 over E / Phi of the lamps on a surface that faces them."""
    square, leaving = lanes(np.float32(0.0)), lanes(np.float32(0.0))
    for k in range(3):
        way = load_row(lamps.centres_mm, k) - np.float32(place_mm[k])
        square = square + way * way
        leaving = leaving - way * load_row(lamps.axes, k)
    leaving = larger(leaving, np.float32(0.0))
    distance = root(square)
    lit = _SQUARE_MM * leaving / (square * distance)
    if lamps.paper:
        lit = lit * leaving / distance
    return np.float32(1.0) / lit


@kernel(error_model="numpy")
def _per_irradiance(centre_mm, normal, lamps):  # type: ignore[no-untyped-def]
    """Return 1 over cos_i E / Phi (`lit_by` of lamp_sight) of the lamps."""
    square, leaving, arriving = lanes(np.float32(0.0)), lanes(np.float32(0.0)), lanes(np.float32(0.0))
    for k in range(3):
        way = load_row(lamps.centres_mm, k) - np.float32(centre_mm[k])
        square = square + way * way
        leaving = leaving - way * load_row(lamps.axes, k)
        arriving = arriving + way * np.float32(normal[k])
    leaving = larger(leaving, np.float32(0.0))
    lit = _SQUARE_MM * leaving * arriving / (square * square)
    if lamps.paper:
        lit = lit * leaving / root(square)
    return np.float32(1.0) / lit


@kernel(error_model="numpy")
def _signal(begin, end, channel, lists, response, darks, shots):  # type: ignore[no-untyped-def]
    """Return the mean of linear signal over the flat field, DN/s, without glare; its relative uncertainty from
    noise; and the glare. Passes are weighted by their variances, or by their times if noise is not known."""
    veil = _veil(begin, end, channel, lists, shots.veils)
    total, weights = lanes(np.float32(0.0)), lanes(np.float32(0.0))
    noisy = not np.isnan(response.noise[channel, 0])
    for number in range(len(shots.slots)):
        mean, variance = _mean(begin, end, channel, lists, response, darks, shots, number)
        if len(shots.slots) == 1:
            mean = mean - veil
            return mean, root(variance) / absolute(mean), veil
        weight = np.float32(1.0) / variance if noisy else lanes(shots.times_s[number])
        weights = weights + if_less(absolute(mean), np.float32(np.inf), weight, np.float32(0.0))
        total = total + if_less(absolute(mean), np.float32(np.inf), weight * mean, np.float32(0.0))
    mean = total / weights - veil
    u_mean = np.float32(1.0) / (root(weights) * absolute(mean)) if noisy else lanes(_NAN)
    return mean, u_mean, veil


@kernel(error_model="numpy")
def _veil(begin, end, channel, lists, veils):  # type: ignore[no-untyped-def]
    """Return the mean over pixels of the veil over the flat field, DN/s. The veil is linear between the middles of
    blocks; 0 without a veil."""
    none, unity, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    total = lanes(none)
    if len(veils.rates) == 0:
        return total
    block_px, rows, columns, width = veils.grid
    first_block = channel * rows * columns
    for pixel in range(begin, end):
        y_px, x_px = divmod(np.int64(lists.places[pixel]), width)
        y = min(max((np.float32(y_px) + half) / np.float32(block_px) - half, none), np.float32(rows - 1))
        x = min(max((np.float32(x_px) + half) / np.float32(block_px) - half, none), np.float32(columns - 1))
        row, column = np.int64(y), np.int64(x)
        below, right = min(row + 1, rows - 1), min(column + 1, columns - 1)
        down, across = y - np.float32(row), x - np.float32(column)
        upper, lower = first_block + row * columns, first_block + below * columns
        left = (
            load_row(veils.rates, upper + column) * (unity - down) + load_row(veils.rates, lower + column) * down
        )
        other = load_row(veils.rates, upper + right) * (unity - down) + load_row(veils.rates, lower + right) * down
        total = total + (left * (unity - across) + other * across) * lists.even[pixel]
    return total * (unity / np.float32(end - begin))


@kernel(error_model="numpy")
def _mean(begin, end, channel, lists, response, darks, shots, number):  # type: ignore[no-untyped-def]
    """Return the mean of one pass, and its variance. They are NaN if there are no pixels, if a pixel is at the top
    of the range, or if the mean is at its bottom."""
    none, unity = np.float32(0.0), np.float32(1.0)
    square, cube = response.curve[channel, 0], response.curve[channel, 1]
    in_dark, gain = response.noise[channel, 0], response.noise[channel, 1]
    slots, dark = shots.slots[number], darks[shots.exposures[number]]
    total, above, variance, highest = lanes(none), lanes(none), lanes(none), lanes(none)
    for pixel in range(begin, end):
        dn, even = gather_lanes(shots.frames, slots, np.int64(lists.places[pixel])), lists.even[pixel]
        highest = larger(highest, dn)
        signal = dn - dark[pixel]
        above = above + signal
        total = total + even * signal * (unity + signal * (square + signal * cube))
        variance = variance + even * even * (in_dark + gain * larger(signal, none))
    count = np.float32(end - begin)
    mean = total * (unity / (count * shots.times_s[number]))
    mean = if_less(highest, response.top_dn, mean, _NAN)
    mean = if_less(response.least_dn * count, above, mean, _NAN)
    mean = if_less(np.float32(0.5), load_row(shots.there, number), mean, _NAN)
    scale = unity / (count * shots.times_s[number])
    return mean, variance * (scale * scale)

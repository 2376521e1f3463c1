"""Slices of reflectance of triangles: coefficients in a basis, from the samples of one view.

A sample's error counts as it shows in a picture, multiplied with the cosine of incidence; what a slice gives is
never below 0. A slice holds for the view that it was fitted to (seed 003, 6.3).
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.least_squares import factorise, one_thread, solve
from coupole.reflectance.slice_basis import COUNT, Basis, functions
from coupole.reflectance.triangle_fit import FEWEST, TriangleSamples

_PART = 64
_FLAT = 1e-9


def fit_slices(
    samples: TriangleSamples,
    used: NDArray[np.bool_],
    basis: Basis,
    model: NDArray[np.float32] | None = None,
    *,
    threads: int | None = None,
) -> NDArray[np.float32]:
    """[b, channels, COUNT] coefficients from those `used` [samples] of one view's samples, or of what a `model`
    [b, samples, channels] leaves of them; NaN where there are too few."""
    count, _, channels = samples.values.shape
    found = np.full((count, channels, COUNT), np.nan, np.float32)
    left = samples.values if model is None else samples.values - model
    camera_mm, which = samples.cameras_mm[0], np.flatnonzero(used)

    def fit(first: int) -> None:
        part = slice(first, min(first + _PART, count))
        _fit_part(
            left[part], samples.led_mm, camera_mm, samples.centres_mm[part], samples.normals[part], which,
            basis.harmonic, basis.penalty, found[part],
        )  # fmt: skip

    with one_thread(), ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        list(pool.map(fit, range(0, count, _PART)))
    return found


def slice_values(
    samples: TriangleSamples,
    coefficients: NDArray[np.float32],
    basis: Basis,
    model: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """[b, samples, channels] f cos_i, 1/sr, that slices, on top of a `model` if they were fitted to what it left,
    give where the samples of one view are; NaN without slice."""
    made = np.zeros(samples.values.shape, np.float32) if model is None else model.copy()
    _add_part(
        coefficients, samples.led_mm, samples.cameras_mm[0], samples.centres_mm, samples.normals, basis.harmonic,
        made,
    )  # fmt: skip
    return np.maximum(made, 0.0)


@numba.njit(cache=True, nogil=True)
def _frame(normal, centre_mm, camera_mm, frame):  # type: ignore[no-untyped-def]
    """Into `frame` [3, 3] the axes of a slice, row by row."""
    x, y, z = normal
    o0, o1, o2 = camera_mm[0] - centre_mm[0], camera_mm[1] - centre_mm[1], camera_mm[2] - centre_mm[2]
    across = o0 * x + o1 * y + o2 * z
    o0, o1, o2 = o0 - across * x, o1 - across * y, o2 - across * z
    length = math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
    if length < _FLAT * abs(across):  # the camera is on the normal: any direction does
        o0, o1, o2 = (1.0 - x * x, -x * y, -x * z) if abs(x) < 0.6 else (-x * y, 1.0 - y * y, -y * z)
        length = math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
    o0, o1, o2 = o0 / length, o1 / length, o2 / length
    frame[0, 0], frame[0, 1], frame[0, 2] = o0, o1, o2
    frame[1, 0], frame[1, 1], frame[1, 2] = y * o2 - z * o1, z * o0 - x * o2, x * o1 - y * o0
    frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z


@numba.njit(cache=True, nogil=True)
def _local(frame, centre_mm, led_mm, direction):  # type: ignore[no-untyped-def]
    """Into `direction` [3] that of the LED in a slice's frame."""
    d0, d1, d2 = led_mm[0] - centre_mm[0], led_mm[1] - centre_mm[1], led_mm[2] - centre_mm[2]
    length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    for k in range(3):
        direction[k] = (frame[k, 0] * d0 + frame[k, 1] * d1 + frame[k, 2] * d2) / length


@numba.njit(cache=True, nogil=True)
def _fit_part(values, led_mm, camera_mm, centres_mm, normals, used, harmonic, penalty, found):  # type: ignore[no-untyped-def]
    count, _, channels = values.shape
    whole, rows = np.empty((len(used), COUNT)), np.empty((len(used), COUNT))
    factor, right = np.zeros((COUNT, COUNT)), np.empty(COUNT)
    frame, direction, cosine = np.empty((3, 3)), np.empty(3), np.empty(len(used))
    for triangle in range(count):
        _frame(normals[triangle], centres_mm[triangle], camera_mm, frame)
        for number in range(len(used)):
            cosine[number] = 0.0
            if _any_known(values[triangle, used[number]]):
                _local(frame, centres_mm[triangle], led_mm[used[number]], direction)
                cosine[number] = direction[2]
                functions(harmonic, direction, whole[number])
        there = False
        for channel in range(channels):
            n = 0
            right[:] = 0.0
            for number in range(len(used)):
                value = values[triangle, used[number], channel]
                if cosine[number] > 0.0 and not math.isnan(value):
                    for k in range(COUNT):
                        rows[n, k] = cosine[number] * whole[number, k]
                        right[k] += rows[n, k] * value
                    n += 1
            if n < FEWEST:
                continue
            if channel == 0 or not there or not _same(values[triangle], used, channel):
                factor[:] = 0.0
                there = factorise(rows[:n], penalty, factor)
            if there:
                solve(factor, right)
                for k in range(COUNT):
                    found[triangle, channel, k] = right[k]


@numba.njit(cache=True, nogil=True)
def _any_known(values):  # type: ignore[no-untyped-def]
    known = False
    for value in values:
        known |= not math.isnan(value)
    return known


@numba.njit(cache=True, nogil=True)
def _same(values, used, channel):  # type: ignore[no-untyped-def]
    """Whether a channel has the same samples as the one before."""
    same = True
    for number in used:
        same &= math.isnan(values[number, channel]) == math.isnan(values[number, channel - 1])
    return same


@numba.njit(cache=True, nogil=True)
def _add_part(coefficients, led_mm, camera_mm, centres_mm, normals, harmonic, made):  # type: ignore[no-untyped-def]
    count, samples, channels = made.shape
    frame, direction, row = np.empty((3, 3)), np.empty(3), np.empty(COUNT)
    for triangle in range(count):
        _frame(normals[triangle], centres_mm[triangle], camera_mm, frame)
        for sample in range(samples):
            _local(frame, centres_mm[triangle], led_mm[sample], direction)
            functions(harmonic, direction, row)
            for channel in range(channels):
                total = 0.0
                for k in range(COUNT):
                    total += coefficients[triangle, channel, k] * row[k]
                made[triangle, sample, channel] += max(direction[2], 0.0) * total

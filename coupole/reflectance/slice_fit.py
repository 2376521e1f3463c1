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

from coupole.reflectance.least_squares import factorise, gram, one_thread, solve
from coupole.reflectance.slice_basis import COUNT, Basis, functions
from coupole.reflectance.triangle_fit import FEWEST, TriangleSamples

_PART = 64
_FLAT = 1e-9


def fit_slices(
    samples: TriangleSamples,
    used: NDArray[np.bool_],
    *fits: tuple[Basis, NDArray[np.float32] | None],
    threads: int | None = None,
) -> list[NDArray[np.float32]]:
    """For each of some fits with the same functions, [b, channels, COUNT] coefficients; NaN for too few samples.

    From those `used` [samples] of one view's samples, or of what a model [b, samples, channels] leaves of them.
    """
    count, _, channels = samples.values.shape
    found = np.full((len(fits), count, channels, COUNT), np.nan, np.float32)
    left = np.stack([samples.values if model is None else samples.values - model for _, model in fits])
    penalties = np.stack([basis.penalty for basis, _ in fits])
    camera_mm, which = samples.cameras_mm[0], np.flatnonzero(used)

    def fit(first: int) -> None:
        part = slice(first, min(first + _PART, count))
        _fit_part(
            samples.values[part], left[:, part], samples.led_mm, camera_mm, samples.centres_mm[part],
            samples.normals[part], which, fits[0][0].harmonic, penalties, found[:, part],
        )  # fmt: skip

    with one_thread(), ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        list(pool.map(fit, range(0, count, _PART)))
    return list(found)


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
def _fit_part(  # type: ignore[no-untyped-def]
    values, left, led_mm, camera_mm, centres_mm, normals, used, harmonic, penalties, found
):
    count, _, channels = values.shape
    whole, rows, which = np.empty((len(used), COUNT)), np.empty((len(used), COUNT)), np.empty(len(used), np.int64)
    product, factor, right = np.zeros((COUNT, COUNT)), np.empty((COUNT, COUNT)), np.empty(COUNT)
    factors, there = np.empty((len(left), COUNT, COUNT)), np.zeros(len(left), np.bool_)
    for triangle in range(count):
        _functions_of(
            values[triangle], used, led_mm, camera_mm, centres_mm[triangle], normals[triangle], harmonic, whole
        )
        n = 0
        for channel in range(channels):
            if channel == 0 or not _same(values[triangle], used, channel):
                n = _gather(values[triangle, :, channel], used, whole, rows, which)
                if n >= FEWEST:
                    gram(rows[:n], product)
                    for fit in range(len(left)):
                        there[fit] = factorise(product, penalties[fit], factor)
                        factors[fit] = factor
            if n < FEWEST:
                continue
            for fit in range(len(left)):
                right[:] = 0.0
                for number in range(n):
                    value = left[fit, triangle, which[number], channel]
                    for k in range(COUNT):
                        right[k] += rows[number, k] * value
                if there[fit]:
                    solve(factors[fit], right)
                    found[fit, triangle, channel] = right


@numba.njit(cache=True, nogil=True)
def _functions_of(values, used, led_mm, camera_mm, centre_mm, normal, harmonic, whole):  # type: ignore[no-untyped-def]
    """Into `whole` [used, COUNT] a triangle's functions times the cosine; a row without sample begins with 0."""
    frame, direction = np.empty((3, 3)), np.empty(3)
    _frame(normal, centre_mm, camera_mm, frame)
    for number in range(len(used)):
        whole[number, 0] = 0.0
        if _any_known(values[used[number]]):
            _local(frame, centre_mm, led_mm[used[number]], direction)
            if direction[2] > 0.0:
                functions(harmonic, direction, whole[number])
                for k in range(COUNT):
                    whole[number, k] *= direction[2]


@numba.njit(cache=True, nogil=True)
def _gather(values, used, whole, rows, which):  # type: ignore[no-untyped-def]
    """Rows and numbers of the samples of a channel that are there; how many."""
    n = 0
    for number in range(len(used)):
        if whole[number, 0] != 0.0 and not math.isnan(values[used[number]]):
            for k in range(COUNT):
                rows[n, k] = whole[number, k]
            which[n] = used[number]
            n += 1
    return n


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

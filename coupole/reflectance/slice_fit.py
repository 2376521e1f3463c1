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

from coupole.reflectance.least_squares import factorise, gram, one_thread, solve, solve_by_samples, sums
from coupole.reflectance.slice_basis import COUNT, LEAST_RESIDUAL, USUAL_LEFT, Basis, functions
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
    The more it leaves, the less are coefficients held.
    """
    count, _, channels = samples.values.shape
    found = np.full((len(fits), count, channels, COUNT), np.nan, np.float32)
    left = np.stack([samples.values if model is None else samples.values - model for _, model in fits])
    penalties = np.stack([basis.penalty for basis, _ in fits])
    over = np.array([model is not None for _, model in fits])
    camera_mm, which = samples.cameras_mm[0], np.flatnonzero(used)

    def fit(first: int) -> None:
        part = slice(first, min(first + _PART, count))
        _fit_part(
            samples.values[part], left[:, part], samples.led_mm, camera_mm, samples.centres_mm[part],
            samples.normals[part], which, fits[0][0].harmonic, penalties, over, found[:, part],
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
def _directions(frame, centre_mm, led_mm, which, x, y, z):  # type: ignore[no-untyped-def]
    """Of the LEDs `which` [n], in a slice's frame; LEDs below the surface get z = 0. How many are above it."""
    above = 0
    for n in range(len(which)):
        led = led_mm[which[n]]
        d0, d1, d2 = led[0] - centre_mm[0], led[1] - centre_mm[1], led[2] - centre_mm[2]
        inverse = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        x[n] = (frame[0, 0] * d0 + frame[0, 1] * d1 + frame[0, 2] * d2) * inverse
        y[n] = (frame[1, 0] * d0 + frame[1, 1] * d1 + frame[1, 2] * d2) * inverse
        z[n] = max(0.0, (frame[2, 0] * d0 + frame[2, 1] * d1 + frame[2, 2] * d2) * inverse)
        above += z[n] > 0.0
    return above


@numba.njit(cache=True, nogil=True)
def _fit_part(  # type: ignore[no-untyped-def]
    values, left, led_mm, camera_mm, centres_mm, normals, used, harmonic, penalties, over, found
):
    """Channels with the same samples share their matrix."""
    count, _, channels = values.shape
    memory, which = np.empty(COUNT * len(used)), np.empty(len(used), np.int64)
    wanted, xyz = np.empty(channels * len(used)), np.empty((3, len(used)))
    product, room = np.zeros((COUNT, COUNT)), np.empty(3 * COUNT * COUNT)
    right, frame, held = np.empty((channels, COUNT)), np.empty((3, 3)), np.empty(COUNT)
    for triangle in range(count):
        _frame(normals[triangle], centres_mm[triangle], camera_mm, frame)
        end = 0
        while end < channels:
            first, end = end, end + 1
            while end < channels and _same(values[triangle], used, end):
                end += 1
            n = _known(values[triangle, :, first], used, which)
            x, y, z = xyz[0, :n], xyz[1, :n], xyz[2, :n]
            if n < FEWEST or _directions(frame, centres_mm[triangle], led_mm, which[:n], x, y, z) < FEWEST:
                continue
            rows = memory[: COUNT * n].reshape(COUNT, n)
            functions(harmonic, x, y, z, rows)
            for k in range(COUNT):
                for number in range(n):
                    rows[k, number] *= z[number]
            if n >= COUNT:
                gram(rows, product)
            mine = wanted[: (end - first) * n].reshape(end - first, n)
            for fit in range(len(left)):
                for number in range(n):
                    for channel in range(first, end):
                        mine[channel - first, number] = left[fit, triangle, which[number], channel]
                held[:] = penalties[fit]
                if over[fit]:
                    held *= _held_by(mine, values[triangle], which[:n], first)
                if _solve(rows, product, held, mine, room, right[: end - first]):
                    found[fit, triangle, first:end] = right[: end - first]


@numba.njit(cache=True, nogil=True)
def _held_by(left, values, which, first):  # type: ignore[no-untyped-def]
    """Share of the usual ridge by which coefficients are held, by what is left [channels, n] of the samples
    `which` [n] in the channels from `first`."""
    remains, whole = 0.0, 0.0
    for channel in range(len(left)):
        for number in range(len(which)):
            remains += left[channel, number] ** 2
            whole += values[which[number], first + channel] ** 2
    return min(1.0, max(LEAST_RESIDUAL, USUAL_LEFT * whole / max(remains, 1e-30)))


@numba.njit(cache=True, nogil=True)
def _solve(rows, product, penalty, values, room, right):  # type: ignore[no-untyped-def]
    """Into `right` the coefficients, the shorter way; whether there are some. `product` is of `gram` where samples
    are as many as functions."""
    if rows.shape[1] < COUNT:
        return solve_by_samples(rows, penalty, values, room, right)
    factor = room[: COUNT * COUNT].reshape(COUNT, COUNT)
    if not factorise(product, penalty, factor):
        return False
    sums(rows, values, right)
    solve(factor, right)
    return True


@numba.njit(cache=True, nogil=True)
def _known(values, used, which):  # type: ignore[no-untyped-def]
    """Into `which` those of the samples `used` that a channel has; how many."""
    n = 0
    for sample in used:
        if not math.isnan(values[sample]):
            which[n] = sample
            n += 1
    return n


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
    frame, which, total = np.empty((3, 3)), np.arange(samples), np.empty(samples)
    x, y, z, rows = np.empty(samples), np.empty(samples), np.empty(samples), np.empty((COUNT, samples))
    for triangle in range(count):
        _frame(normals[triangle], centres_mm[triangle], camera_mm, frame)
        _directions(frame, centres_mm[triangle], led_mm, which, x, y, z)
        functions(harmonic, x, y, z, rows)
        for channel in range(channels):
            total[:] = 0.0
            for k in range(COUNT):
                coefficient = coefficients[triangle, channel, k]
                for sample in range(samples):
                    total[sample] += coefficient * rows[k, sample]
            for sample in range(samples):
                made[triangle, sample, channel] += z[sample] * total[sample]

"""Slices of reflectance of triangles: coefficients in a basis, from the samples of one view.

A sample's error is weighted as it appears in a picture, multiplied by the cosine of incidence. A slice's values
are never below 0. A slice is valid for the view to which it was fitted (Lucat et al. 2025, 6.3).

A fit to the residual of a model is stacked with a fit to the samples themselves (Breiman, Stacked regressions,
Machine Learning 24, 1996): the chosen share of the model has the smallest error for left-out samples.
"""

from __future__ import annotations

import math

import numpy as np
from numpy import ascontiguousarray as ordered  # functions are compiled for each layout
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.kernel_arrays import assign_rows
from coupole.reflectance.least_squares import (
    factorise,
    gram,
    left_out,
    one_thread,
    solve,
    solve_by_samples,
    sums,
)
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.slice_basis import COUNT, LEAST_RESIDUAL, USUAL_LEFT, Basis, functions
from coupole.reflectance.triangle_fit import FEWEST, TriangleSamples

_PART = 64
_FLAT = 1e-9
_LEFT_OUT = 64
"""Least number of samples from which the share of a model is chosen; fewer if there are not enough."""


def fit_slices(
    samples: TriangleSamples,
    sample_mask: NDArray[np.bool_],
    *fits: tuple[Basis, NDArray[np.float32] | None],
    threads: int | None = None,
) -> list[NDArray[np.float32]]:
    """Return coefficients [b, channels, COUNT] for each of some fits with the same functions; NaN for too few
    samples.

    The fits use the samples `sample_mask` [samples] of one view. With a model [b, samples, channels] a fit is
    added to a share of the model, which is one more coefficient at the end. The result is a weighted mean of a fit
    to the model's residual and a fit to the samples; the weights depend on how well each predicts samples. The
    larger the residual, the smaller is the ridge.
    """
    count, _, channels = samples.values.shape
    coefficients = np.full((len(fits), count, channels, COUNT + 1), np.nan, np.float32)
    residuals = np.stack([samples.values if model is None else samples.values - model for _, model in fits])
    penalties = np.stack([basis.penalty for basis, _ in fits])
    over = np.array([model is not None for _, model in fits])
    camera_mm, indices = samples.cameras_mm[0], np.flatnonzero(sample_mask)

    def fit(first: int) -> None:
        part = slice(first, min(first + _PART, count))
        part_coefficients = ordered(coefficients[:, part])
        _fit_part(
            ordered(samples.values[part]), ordered(residuals[:, part]), ordered(samples.led_mm),
            ordered(camera_mm), ordered(samples.centres_mm[part]), ordered(samples.normals[part]), indices,
            fits[0][0].harmonic, penalties, over, part_coefficients,
        )  # fmt: skip
        coefficients[:, part] = part_coefficients

    with one_thread():
        in_threads(fit, count, part=_PART, threads=threads)
    return [
        fit_coefficients if model is not None else fit_coefficients[..., :COUNT]
        for fit_coefficients, (_, model) in zip(coefficients, fits, strict=True)
    ]


def slice_values(
    samples: TriangleSamples,
    coefficients: NDArray[np.float32],
    basis: Basis,
    model: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """[b, samples, channels] f cos_i, 1/sr, of slices at the samples of one view. If the slices were fitted with a
    `model`, their share of it is added. For a triangle without slice it is the model, or NaN."""
    values = np.zeros(samples.values.shape, np.float32)
    if model is not None:
        share = coefficients[..., COUNT]
        values = ordered(np.nan_to_num(share, nan=1.0)[:, None] * model)
        coefficients = np.nan_to_num(coefficients[..., :COUNT])
    _add_part(
        ordered(coefficients), ordered(samples.led_mm), ordered(samples.cameras_mm[0]),
        ordered(samples.centres_mm), ordered(samples.normals), basis.harmonic, values,
    )  # fmt: skip
    return np.maximum(values, 0.0)


@kernel
def _frame(normal, centre_mm, camera_mm, frame):  # type: ignore[no-untyped-def]
    """Fill `frame` [3, 3] with the axes of a slice, row by row."""
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


@kernel
def _directions(frame, centre_mm, led_mm, led_numbers, x, y, z):  # type: ignore[no-untyped-def]
    """Fill `x`, `y` and `z` with the directions of the LEDs `led_numbers` [n] in a slice's frame; LEDs below the
    surface get z = 0. Return the number of LEDs above the surface."""
    above = 0
    for n in range(len(led_numbers)):
        led = led_mm[led_numbers[n]]
        d0, d1, d2 = led[0] - centre_mm[0], led[1] - centre_mm[1], led[2] - centre_mm[2]
        inverse = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        x[n] = (frame[0, 0] * d0 + frame[0, 1] * d1 + frame[0, 2] * d2) * inverse
        y[n] = (frame[1, 0] * d0 + frame[1, 1] * d1 + frame[1, 2] * d2) * inverse
        z[n] = max(0.0, (frame[2, 0] * d0 + frame[2, 1] * d1 + frame[2, 2] * d2) * inverse)
        above += z[n] > 0.0
    return above


@kernel
def _fit_part(  # type: ignore[no-untyped-def]
    values,
    residuals,
    led_mm,
    camera_mm,
    centres_mm,
    normals,
    used_samples,
    harmonic,
    penalties,
    over,
    coefficients,
):
    """Fit some triangles; channels with the same samples share their matrix."""
    count, _, channels = values.shape
    memory, indices = np.empty(COUNT * len(used_samples)), np.empty(len(used_samples), np.int64)
    xyz, product, frame = np.empty((3, len(used_samples))), np.zeros((COUNT, COUNT)), np.empty((3, 3))
    room, shape = np.empty(2 * COUNT * COUNT), (channels, len(used_samples))
    own_memory = (np.empty(COUNT), np.empty((COUNT, COUNT)), np.empty(shape), np.empty((channels, COUNT)))
    plain_memory = (np.empty(COUNT), np.empty((COUNT, COUNT)), np.empty(shape), np.empty((channels, COUNT)))
    for triangle in range(count):
        _frame(normals[triangle], centres_mm[triangle], camera_mm, frame)
        end = np.int64(0)  # no literal, for which functions would be compiled once more
        while end < channels:
            first, end = end, end + 1
            while end < channels and _same(values[triangle], used_samples, end):
                end += 1
            n = _known_samples(values[triangle, :, first], used_samples, indices)
            x, y, z = xyz[0, :n], xyz[1, :n], xyz[2, :n]
            if n < FEWEST or _directions(frame, centres_mm[triangle], led_mm, indices[:n], x, y, z) < FEWEST:
                continue
            rows = memory[: COUNT * n].reshape(COUNT, n)
            functions(harmonic, x, y, z, rows)
            for k in range(COUNT):
                for number in range(n):
                    rows[k, number] *= z[number]
            if n >= COUNT:
                gram(rows, product)
            plain_memory[0][:] = np.nan
            for fit in range(len(residuals)):
                _fit_one(
                    rows, product, values[triangle], residuals[fit, triangle], indices[:n], first, penalties[fit],
                    over[fit], room, own_memory, plain_memory, coefficients[fit, triangle, first:end],
                )  # fmt: skip


@kernel
def _fit_one(  # type: ignore[no-untyped-def]
    rows,
    product,
    values,
    residuals,
    sample_numbers,
    first,
    penalty,
    over,
    room,
    own_memory,
    plain_memory,
    coefficients,
):
    """Fill `coefficients` [channels, COUNT + 1] with a fit to `residuals` of the samples `sample_numbers` [n], in
    the channels from `first` on. `own_memory` and `plain_memory` are working memory. The latter keeps the fit to
    the samples themselves with its ridge, because another fit of the same channels may need it too."""
    channels, n = len(coefficients), len(sample_numbers)
    own_fit, plain_fit = _memory_of(own_memory, channels, n), _memory_of(plain_memory, channels, n)
    if not over:
        if _fit_targets(rows, product, values, sample_numbers, first, penalty, 1.0, room, plain_fit):
            assign_rows(coefficients[:, :COUNT], plain_fit[3])
            coefficients[:, COUNT] = 1.0
        return
    ridge, factor, targets, right = own_fit
    _take_samples(residuals, sample_numbers, first, targets)
    share = _held_by(targets, values, sample_numbers, first)
    ridge[:] = np.nan
    if not _fit_targets(rows, product, residuals, sample_numbers, first, penalty, share, room, own_fit):
        return
    assign_rows(coefficients[:, :COUNT], right)
    coefficients[:, COUNT] = 1.0
    step = max(1, n // _LEFT_OUT)
    off = np.empty((2, channels, (n + step - 1) // step))
    left_out(rows, targets, right, factor, step, off[0])
    if _fit_targets(rows, product, values, sample_numbers, first, penalty, LEAST_RESIDUAL, room, plain_fit):
        left_out(rows, plain_fit[2], plain_fit[3], plain_fit[1], step, off[1])
        _stack(off, plain_fit[3], coefficients)


@kernel
def _memory_of(memory, channels, samples):  # type: ignore[no-untyped-def]
    """Return the working memory of a fit: its ridge [COUNT]; its factor; targets [channels, samples]; and
    coefficients [channels, COUNT]."""
    ridge, factor, targets, right = memory
    size = min(samples, COUNT)
    return (
        ridge,
        factor.reshape(-1)[: size * size].reshape(size, size),
        targets.reshape(-1)[: channels * samples].reshape(channels, samples),
        right[:channels],
    )


@kernel
def _fit_targets(rows, product, values, sample_numbers, first, penalty, share, room, memory):  # type: ignore[no-untyped-def]
    """Fit the functions to the samples `sample_numbers` [n] of `values`, in the channels from `first` on, with a
    ridge that is `share` of the penalty. Return whether there is a solution. A `memory` with this ridge has the
    solution already."""
    ridge, factor, targets, right = memory
    is_there = True
    for k in range(COUNT):
        is_there &= ridge[k] == share * penalty[k]
        ridge[k] = share * penalty[k]
    if is_there:
        return True
    _take_samples(values, sample_numbers, first, targets)
    is_solved = _solve(rows, product, ridge, targets, room, factor, right)
    if not is_solved:
        ridge[:] = np.nan
    return is_solved


@kernel
def _take_samples(values, sample_numbers, first, targets):  # type: ignore[no-untyped-def]
    """Fill `targets` [channels, n] with the samples `sample_numbers` [n] in the channels from `first` on."""
    for channel in range(len(targets)):
        for number in range(len(sample_numbers)):
            targets[channel, number] = values[sample_numbers[number], first + channel]


@kernel
def _stack(off, plain, coefficients):  # type: ignore[no-untyped-def]
    """Combine `coefficients` [channels, COUNT + 1] (a model and its residual) and `plain` [channels, COUNT] into
    the weighted mean with the smallest error. `off` [2, channels, samples] are the errors of both.
    """
    covariance, apart = 0.0, 0.0
    for channel in range(off.shape[1]):
        for number in range(off.shape[2]):
            between = off[1, channel, number] - off[0, channel, number]
            covariance += between * off[1, channel, number]
            apart += between * between
    share = min(1.0, max(0.0, covariance / max(apart, 1e-30)))
    for channel in range(len(coefficients)):
        coefficients[channel, COUNT] = share
        for k in range(COUNT):
            coefficients[channel, k] = share * coefficients[channel, k] + (1.0 - share) * plain[channel, k]


@kernel
def _held_by(residuals, values, sample_numbers, first):  # type: ignore[no-untyped-def]
    """Return the factor on the usual ridge, from the residuals [channels, n] of the samples `sample_numbers` [n]
    in the channels from `first` on."""
    remains, whole = 0.0, 0.0
    for channel in range(len(residuals)):
        for number in range(len(sample_numbers)):
            remains += residuals[channel, number] ** 2
            whole += values[sample_numbers[number], first + channel] ** 2
    return min(1.0, max(LEAST_RESIDUAL, USUAL_LEFT * whole / max(remains, 1e-30)))


@kernel
def _solve(rows, product, penalty, values, room, factor, right):  # type: ignore[no-untyped-def]
    """Fill `right` with the coefficients; return whether there is a solution. The equations are solved by samples
    or by functions, whichever are fewer. `product` comes from `gram` if there are at least as many samples as
    functions.
    """
    if rows.shape[1] < COUNT:
        return solve_by_samples(rows, penalty, values, room, factor, right)
    if not factorise(product, penalty, factor):
        return False
    sums(rows, values, right)
    solve(factor, right)
    return True


@kernel
def _known_samples(values, used_samples, sample_numbers):  # type: ignore[no-untyped-def]
    """Fill `sample_numbers` with those of the samples `used_samples` in which a channel has a value; return their
    number."""
    n = 0
    for sample in used_samples:
        if not math.isnan(values[sample]):
            sample_numbers[n] = sample
            n += 1
    return n


@kernel
def _same(values, used_samples, channel):  # type: ignore[no-untyped-def]
    """Tell whether a channel has the same samples as the one before."""
    same = True
    for number in used_samples:
        same &= math.isnan(values[number, channel]) == math.isnan(values[number, channel - 1])
    return same


@kernel
def _add_part(coefficients, led_mm, camera_mm, centres_mm, normals, harmonic, modelled_values):  # type: ignore[no-untyped-def]
    count, samples, channels = modelled_values.shape
    frame, indices, total = np.empty((3, 3)), np.arange(samples), np.empty(samples)
    x, y, z, rows = np.empty(samples), np.empty(samples), np.empty(samples), np.empty((COUNT, samples))
    for triangle in range(count):
        _frame(normals[triangle], centres_mm[triangle], camera_mm, frame)
        _directions(frame, centres_mm[triangle], led_mm, indices, x, y, z)
        functions(harmonic, x, y, z, rows)
        for channel in range(channels):
            total[:] = 0.0
            for k in range(COUNT):
                coefficient = coefficients[triangle, channel, k]
                for sample in range(samples):
                    total[sample] += coefficient * rows[k, sample]
            for sample in range(samples):
                modelled_values[triangle, sample, channel] += z[sample] * total[sample]

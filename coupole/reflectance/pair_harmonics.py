"""Reflectance as one function of both directions: spherical harmonics of pairs, for light and view.

Products of Y(l, m) of the light's direction and Y(l', m') of the view's are a basis of functions on pairs. If
reflectance changes neither when both directions turn about the normal nor when they are mirrored, only products
with equal m are needed. They are summed over m and -m: P(l, m) P(l', m) cos(m phi), where phi is the angle between
the azimuths. By reciprocity l and l' can be exchanged. So d degrees need d (d + 1) (d + 2) / 6 functions: 220 for
10, 969 for 17. The functions are orthonormal over all pairs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from coupole.kernels import kernel
from coupole.reflectance.clustering import Pool, axes_about, turned_to
from coupole.reflectance.slice_basis import diagonal, recurrence
from coupole.reflectance.triangle_fit import FEWEST, TriangleSamples

Floats = NDArray[np.float64]

USUAL_DEGREES, MOST_DEGREES = 10, 17
TIKHONOV, _LEAST = 0.1, 1e-3
"""Ridge of the highest degrees, as a share of the mean diagonal of the normal matrix; ridge of the lowest degrees,
as a share of the ridge of the highest. On a simulated glossy surface, a tenth and ten times this ridge changed the
error under left-out lights and in a left-out view by 3 % at most."""
_TABLES = (*recurrence(MOST_DEGREES), diagonal(MOST_DEGREES))


def count_of(degrees: int) -> int:
    return degrees * (degrees + 1) * (degrees + 2) // 6


def pair_functions(lights: Floats, views: Floats, degrees: int) -> Floats:
    """[n, count_of(degrees)] functions of pairs of unit vectors [n, 3], where z is the normal. They are in the
    order of l, then of l' from l on, then of m from 0 to l."""
    functions = np.empty((len(lights), count_of(degrees)))
    _functions(lights, views, degrees, *_TABLES, functions)
    return functions


def fit_pairs(pool: Pool, degrees: int) -> NDArray[np.float32]:
    """[clusters, count_of(degrees), channels] coefficients of reflectance, 1/sr, by least squares of f cos_i with
    Tikhonov's ridge, which grows with the degrees; NaN for pools with too few samples."""
    coefficients = np.full((len(pool.counts), count_of(degrees), pool.values.shape[2]), np.nan, np.float32)
    ridge = TIKHONOV * (_LEAST + _roll_off(degrees))
    for number, count in enumerate(pool.counts):
        if count < FEWEST:
            continue
        lights, views = (directions[number, :count].astype(np.float64) for directions in (pool.lights, pool.views))
        rows = pair_functions(lights, views, degrees) * lights[:, 2:]
        normal = rows.T @ rows
        normal[np.diag_indices_from(normal)] += ridge * np.trace(normal) / len(normal)
        coefficients[number] = cho_solve(cho_factor(normal), rows.T @ pool.values[number, :count])
    return coefficients


def pair_values(
    samples: TriangleSamples, normals: Floats, cluster: NDArray[np.integer], coefficients: NDArray[np.float32]
) -> NDArray[np.float32]:
    """[b, samples, channels] f cos_i for the measured samples, by the `cluster` [b] of each triangle, not below 0;
    NaN for triangles without a cluster."""
    modelled_values = np.full(samples.values.shape, np.nan, np.float32)
    degrees = next(d for d in range(MOST_DEGREES + 1) if count_of(d) == coefficients.shape[1])
    _values(
        samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm, normals, cluster,
        coefficients.astype(np.float64), degrees, *_TABLES, modelled_values,
    )  # fmt: skip
    return modelled_values


def _roll_off(degrees: int) -> Floats:
    """[count] weights of the ridge: 0 for the constant, 1 for the highest pair, growing as the square of the
    bending."""
    bending = [first * (first + 1) + second * (second + 1) for first, second, _ in _orders(degrees)]
    return np.asarray((np.array(bending, float) / (2 * degrees * (degrees - 1))) ** 2)


def _orders(degrees: int) -> list[tuple[int, int, int]]:
    """Return l, l' and m of each function."""
    every = range(degrees)
    return [
        (low_order, high_order, m)
        for low_order in every
        for high_order in every[low_order:]
        for m in range(low_order + 1)
    ]


@kernel
def _legendre(z, degrees, a, b, first, polynomials):  # type: ignore[no-untyped-def]
    """Fill `polynomials` [degrees, degrees] with P(l, m) of z. The factor of P(l, m) that is a power of the
    distance from the z axis is left out."""
    p_mm = math.sqrt(0.25 / math.pi)
    for m in range(degrees):
        p_mm *= first[m]
        before, now = 0.0, p_mm
        polynomials[m, m] = now
        for degree in range(m + 1, degrees):
            before, now = now, a[degree, m] * (z * now - b[degree, m] * before)
            polynomials[degree, m] = now


@kernel
def _pair(light, view, degrees, a, b, first, of_light, of_view, cosines, row):  # type: ignore[no-untyped-def]
    _legendre(light[2], degrees, a, b, first, of_light)
    _legendre(view[2], degrees, a, b, first, of_view)
    real, imaginary = light[0] * view[0] + light[1] * view[1], light[1] * view[0] - light[0] * view[1]
    cosine, sine = 1.0, 0.0
    for m in range(degrees):  # real parts of the powers of the product of x + iy and x' - iy'
        cosines[m] = cosine * (math.sqrt(2.0) if m else 1.0)
        cosine, sine = cosine * real - sine * imaginary, cosine * imaginary + sine * real
    place = 0
    for low_order in range(degrees):
        for high_order in range(low_order, degrees):
            for m in range(low_order + 1):
                value = of_light[low_order, m] * of_view[high_order, m]
                if low_order != high_order:
                    value = math.sqrt(0.5) * (value + of_light[high_order, m] * of_view[low_order, m])
                row[place] = value * cosines[m]
                place += 1


@kernel
def _functions(lights, views, degrees, a, b, first, harmonics):  # type: ignore[no-untyped-def]
    of_light, of_view, cosines = np.empty((degrees, degrees)), np.empty((degrees, degrees)), np.empty(degrees)
    for n in range(len(lights)):
        _pair(lights[n], views[n], degrees, a, b, first, of_light, of_view, cosines, harmonics[n])


@kernel
def _values(  # type: ignore[no-untyped-def]
    led_mm, view_of, cameras_mm, centres_mm, normals, cluster, coefficients, degrees, a, b, first, modelled_values
):
    of_light, of_view, cosines = np.empty((degrees, degrees)), np.empty((degrees, degrees)), np.empty(degrees)
    row, axes, light, view = np.empty(coefficients.shape[1]), np.empty((3, 3)), np.empty(3), np.empty(3)
    for triangle in range(len(centres_mm)):
        if cluster[triangle] < 0:
            continue
        axes_about(normals[triangle], axes)
        for sample in range(len(led_mm)):
            turned_to(axes, centres_mm[triangle], led_mm[sample], light)
            turned_to(axes, centres_mm[triangle], cameras_mm[view_of[sample]], view)
            if light[2] <= 0.0 or view[2] <= 0.0:
                continue
            _pair(light, view, degrees, a, b, first, of_light, of_view, cosines, row)
            for channel in range(modelled_values.shape[2]):
                total = 0.0
                for n in range(len(row)):
                    total += row[n] * coefficients[cluster[triangle], n, channel]
                modelled_values[triangle, sample, channel] = 0.0 if total < 0.0 else total * light[2]  # NaN stays

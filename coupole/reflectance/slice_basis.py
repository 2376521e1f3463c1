"""Bases for a slice of reflectance. A slice is the reflectance of a point in one view, as a function of the
light's direction.

Directions are unit vectors in the slice's frame: z the mesh's normal, x towards the camera along the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

Floats = NDArray[np.float64]

COUNT = 100
"""Number of coefficients of each basis, as in Lucat et al. 2025, 6.3."""
_DEGREES = 10
TIKHONOV = 0.1
"""Penalty of the highest degree of the harmonics (Lucat et al. 2025, 5.2)."""
_TAIL = 4
_RADIAL, _RESIDUAL = 1e-3, 0.1
"""Ridge of the radial functions: for reflectance, and for the residual of a material, which is mostly noise. Both
were chosen on simulated glossy reliefs by leaving lights out; a tenth and ten times the ridge change the error by
5 %."""
USUAL_LEFT = 2e-4
"""Residual that a material of exactly the fit's form leaves, as a share of the samples' sum of squares. If the
residual is larger, its ridge is smaller in proportion, down to the ridge of reflectance."""
LEAST_RESIDUAL = _RADIAL / _RESIDUAL
"""Factor on the ridge of a material's residual if the residual is large."""
_TAIL_SHARE = 0.01
_HELD = 1e9
"""Ridge of a coefficient that is held at 0."""


@dataclass(frozen=True)
class Basis:
    """Functions of a direction, and the penalty that keeps their coefficients small."""

    harmonic: bool
    """True for spherical harmonics, False for radial functions with a linear tail."""
    penalty: Floats
    """[COUNT]"""


def _degrees() -> NDArray[np.int64]:
    """[COUNT] degrees of the harmonics, in the order of `_harmonics`."""
    return np.concatenate([np.full(2 * degree + 1, degree) for degree in range(_DEGREES)])


def _roll_off() -> Floats:
    """[COUNT] weights of the penalty: 0 for the constant, 1 for the highest degree, so that high degrees do not
    ring. A window on the coefficients after the fit would increase the error, because the functions are not
    orthogonal on half a sphere."""
    degrees = _degrees()
    return (degrees * (degrees + 1) / (_DEGREES * (_DEGREES - 1))) ** 4.0


def centres() -> Floats:
    """[COUNT - 4, 3] centres of the radial functions: a Fibonacci spiral on the half sphere."""
    number = np.arange(COUNT - _TAIL) + 0.5
    z = 1.0 - number / len(number)
    azimuth = number * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


def _ridge(weight: float) -> Floats:
    return np.append(np.full(COUNT - _TAIL, weight), np.full(_TAIL, _TAIL_SHARE * weight))


HARMONICS = Basis(True, 1e-6 + TIKHONOV * _roll_off())
"""Real, orthonormal spherical harmonics, degrees 0 to 9."""
RADIAL = Basis(False, _ridge(_RADIAL))
"""Functions -r of the distance r to each centre, then 1, x, y, z."""
RESIDUAL = Basis(False, _ridge(_RESIDUAL))
BASES = {"harmonics": HARMONICS, "radial": RADIAL, "residual": RESIDUAL}
"""Bases by the names that fits have for them."""


def fewer(basis: Basis, count: int) -> Basis:
    """Return the same basis with about `count` free coefficients; the others are held at 0. Whole degrees stay
    free, or the tail and centres that are spread over all centres."""
    if basis.harmonic:
        free = _degrees() < int(count**0.5)
    else:
        free = np.ones(COUNT, np.bool_)
        places = np.linspace(0, COUNT - _TAIL - 1, count - _TAIL).astype(int)
        free[: COUNT - _TAIL] = np.isin(np.arange(COUNT - _TAIL), places)
    return Basis(basis.harmonic, np.where(free, basis.penalty, _HELD))


def recurrence(degrees: int) -> tuple[Floats, Floats]:
    """[degrees, degrees] a and b of P(l, m) = a (z P(l-1, m) - b P(l-2, m)), orthonormal, without (x + iy)^m."""
    a, b = np.zeros((degrees, degrees)), np.zeros((degrees, degrees))
    for l in range(1, degrees):  # noqa: E741  degree and order have these names everywhere
        for m in range(l):
            a[l, m] = math.sqrt((4.0 * l * l - 1.0) / (l * l - m * m))
            b[l, m] = math.sqrt(((l - 1.0) ** 2 - m * m) / (4.0 * (l - 1.0) ** 2 - 1.0))
    return a, b


def diagonal(degrees: int) -> Floats:
    """[degrees] ratios of P(m, m) to P(m - 1, m - 1)."""
    return np.array([1.0, *(math.sqrt((2.0 * m + 1.0) / (2.0 * m)) for m in range(1, degrees))])


_A, _B = recurrence(_DEGREES)
_DIAGONAL = diagonal(_DEGREES)
_CENTRES = centres()


@kernel
def functions(harmonic, x, y, z, rows):  # type: ignore[no-untyped-def]
    """Write the values of a basis in directions x, y, z [n] to `rows` [COUNT, n]."""
    if harmonic:
        _harmonics(x, y, z, rows)
    else:
        _radial(x, y, z, rows)


@kernel
def _harmonics(x, y, z, rows):  # type: ignore[no-untyped-def]
    """Write Y(l, m) to row l (l + 1) + m: sqrt 2 P(l, |m|) times Re or Im of (x + iy)^|m|."""
    cosine, sine = np.ones(len(x)), np.zeros(len(x))
    before, now = np.empty(len(x)), np.empty(len(x))
    p_mm = math.sqrt(0.25 / math.pi)
    for m in range(_DEGREES):
        p_mm *= _DIAGONAL[m]
        if m == 1:
            for n in range(len(x)):
                cosine[n], sine[n] = math.sqrt(2.0) * x[n], math.sqrt(2.0) * y[n]
        for n in range(len(x) if m > 1 else 0):
            cosine[n], sine[n] = x[n] * cosine[n] - y[n] * sine[n], x[n] * sine[n] + y[n] * cosine[n]
        before[:], now[:] = 0.0, p_mm
        for degree in range(m, _DEGREES):
            a, b = _A[degree, m], _B[degree, m]
            for n in range(len(x) if degree > m else 0):
                before[n], now[n] = now[n], a * (z[n] * now[n] - b * before[n])
            middle = degree * (degree + 1)
            for n in range(len(x) if m > 0 else 0):
                rows[middle - m, n] = now[n] * sine[n]
            for n in range(len(x)):
                rows[middle + m, n] = now[n] * cosine[n]


@kernel
def _radial(x, y, z, rows):  # type: ignore[no-untyped-def]
    count = len(_CENTRES)
    for k in range(count):
        cx, cy, cz = _CENTRES[k]
        for n in range(len(x)):
            dx, dy, dz = x[n] - cx, y[n] - cy, z[n] - cz
            rows[k, n] = -math.sqrt(dx * dx + dy * dy + dz * dz)
    for n in range(len(x)):
        rows[count, n], rows[count + 1, n], rows[count + 2, n], rows[count + 3, n] = 1.0, x[n], y[n], z[n]

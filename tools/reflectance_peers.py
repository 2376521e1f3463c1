"""Fits of the same samples by other libraries, with which `bench_reflectance` compares Coupole."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray


def sgemm_products(samples: int, count: int, cores: int) -> None:
    """Compute the products that the normal equations of the same number of triangles need: 100 functions with
    themselves and with three channels."""
    from scipy.linalg.blas import sgemm

    a = np.asfortranarray(np.random.default_rng(0).random((samples, 100), np.float32))
    b = np.asfortranarray(np.random.default_rng(1).random((samples, 103), np.float32))

    def some(_: int) -> None:
        for _ in range(count // cores):
            sgemm(1.0, a, b, trans_a=True)

    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(some, range(cores)))


def _frame_of(samples: Any, triangle: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return [n, 3] directions to the lights in the slice's frame, the axes [3, 3], and a mask of existing
    samples."""
    normal, centre = samples.normals[triangle], samples.centres_mm[triangle]
    across = samples.cameras_mm[0] - centre
    across -= normal * (across @ normal)
    axes = np.stack([across, np.cross(normal, across), normal])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    there = np.isfinite(samples.values[triangle]).all(axis=1)
    light = samples.led_mm[there] - centre
    return (light / np.linalg.norm(light, axis=1, keepdims=True)) @ axes.T, axes, there


def scipy_harmonics(samples: Any) -> None:
    """Solve the same normal equations, triangle by triangle."""
    from scipy.linalg import cho_factor, cho_solve
    from scipy.special import sph_harm_y_all

    from coupole.reflectance.slice_basis import HARMONICS

    for triangle in range(len(samples.values)):
        light, _, there = _frame_of(samples, triangle)
        harmonics = sph_harm_y_all(9, 9, np.arccos(light[:, 2]), np.arctan2(light[:, 1], light[:, 0]))
        rows = np.concatenate(
            [
                part
                for degree in range(10)
                for part in (harmonics[degree, : degree + 1].real, harmonics[degree, 1 : degree + 1].imag)
            ]
        )
        rows *= light[:, 2]
        matrix = rows @ rows.T + np.diag(HARMONICS.penalty)
        cho_solve(cho_factor(matrix), rows @ samples.values[triangle][there])


def scipy_ggx(samples: Any) -> None:
    """Solve the same robust problem from the same three starts, with a fitted normal, triangle by triangle."""
    from scipy.optimize import least_squares

    for triangle in range(len(samples.values)):
        light, axes, there = _frame_of(samples, triangle)
        view = samples.cameras_mm[0] - samples.centres_mm[triangle]
        view = axes @ (view / np.linalg.norm(view))
        half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
        roots = np.sqrt(np.maximum(samples.values[triangle][there].mean(axis=1), 0.0))
        kd = float(np.median(roots**2 / np.maximum(light[:, 2], 0.02)))

        def off(x: Any, light: Any = light, view: Any = view, half: Any = half, roots: Any = roots) -> Any:
            normal = np.array([x[0], x[1], 1.0])
            normal /= np.linalg.norm(normal)
            nl, nv, nh = np.maximum(light @ normal, 1e-9), max(normal @ view, 1e-9), half @ normal
            a2 = np.exp(2 * x[4])
            d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
            s = nl * np.sqrt(a2 + (1 - a2) * nv * nv) + nv * np.sqrt(a2 + (1 - a2) * nl * nl)
            return np.sqrt(nl * (np.exp(x[2]) + np.exp(x[3]) * 0.5 * d / s)) - roots

        for alpha in (0.08, 0.2, 0.45):
            start = [0.0, 0.0, np.log(kd), np.log(0.02 * kd), np.log(alpha)]
            least_squares(off, start, loss="cauchy", f_scale=0.05 * kd**0.5, ftol=1e-5)

"""Eight samples at once reach the minima that SciPy finds of the cost as it is written down."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from coupole.reflectance import ggx_fit
from coupole.reflectance.ggx_fit import ROWS, fit_packs, pack

STARTS = (0.08, 0.2, 0.45)
STIFFNESS, USUAL = 2000.0, 0.1
USUAL_MATERIAL = (math.log(0.04), math.log(0.3), USUAL / 4.0, USUAL)
UP = np.array([0.0, 0.0, 1.0])


def directions(random: Any, count: int, spread: float) -> Any:
    ways = random.normal(0, spread, (count, 3)) + UP
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


def radiance(x: Any, lights: Any, views: Any) -> Any:
    """(n l) (kd + ks D V) (Walter et al. 2007, eq. 33; Heitz 2014, eqs. 72 and 99: by Lambda); x is slopes of the
    normal, then logarithms."""
    normal = np.array([x[0], x[1], 1.0]) / math.hypot(x[0], x[1], 1.0)
    kd, ks, alpha = np.exp(x[2:])
    half = (lights + views) / np.linalg.norm(lights + views, axis=1, keepdims=True)
    nl, nv, nh = np.maximum(lights @ normal, 1e-12), views @ normal, half @ normal
    tan2 = 1 / nh**2 - 1
    d = 1 / (np.pi * alpha**2 * nh**4 * (1 + tan2 / alpha**2) ** 2)
    shadow = [(np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) / 2 for c in (nl, nv)]
    return np.where(lights @ normal > 0, nl * kd + ks * d / (1 + shadow[0] + shadow[1]) / (4 * nv), 0.0)


def cost(x: Any, roots: Any, lights: Any, views: Any, scale: float) -> float:
    """Cauchy's, of square roots, and what holds normal, ks and alpha."""
    off = (np.sqrt(radiance(x, lights, views)) - roots) / scale
    normal = np.array([x[0], x[1], 1.0]) / math.hypot(x[0], x[1], 1.0)
    held = STIFFNESS * np.sum((normal - UP) ** 2)
    usual = USUAL * ((x[4] - math.log(0.3)) ** 2 + ((x[3] - math.log(0.04)) / 2.0) ** 2)
    return float(np.sum(np.log1p(off**2)) + held + usual)


@pytest.mark.parametrize("count", [24, 45, 131])
def test_the_least_costs_are_those_that_scipy_finds(count: int) -> None:
    random = np.random.default_rng(count)
    for _ in range(4):
        lights, views = directions(random, count, 0.5), directions(random, 2, 0.2)
        view_of = random.integers(0, 2, count)
        seen_from = views[view_of]
        kd, ks, alpha = np.exp(random.uniform(np.log([0.03, 0.005, 0.1]), np.log([0.3, 0.1, 0.5])))
        true = [*random.normal(0, 0.02, 2), *np.log([kd, ks, alpha])]
        roots = np.sqrt(radiance(true, lights, seen_from)) * random.normal(1, 0.02, count)
        roots[: count // 8] *= 0.4  # in some shadow
        half = (lights + seen_from) / np.linalg.norm(lights + seen_from, axis=1, keepdims=True)
        packs = np.empty((count // 8 + 1, ROWS, 8))
        filled = pack(roots, np.arange(count), lights, half, views, view_of, packs)
        scale, found, known = 0.05 * math.sqrt(kd), [], []
        for first in STARTS:
            start = [0.0, 0.0, math.log(kd), math.log(0.02 * kd), math.log(first)]
            unknowns = np.array([*UP, *start[2:]])
            ours, _ = fit_packs(packs[:filled], views, unknowns, UP, STIFFNESS, USUAL_MATERIAL, 1e-5)
            end = [*(unknowns[:2] / unknowns[2]), *unknowns[3:]]
            assert ours == pytest.approx(cost(end, roots, lights, seen_from, scale), rel=1e-9)
            found.append(ours)
            bounds = [(-0.5, 0.5)] * 2 + [(-12.0, 2.0)] * 2 + [(math.log(0.02), 0.0)]
            known.append(minimize(cost, start, (roots, lights, seen_from, scale), "L-BFGS-B", bounds=bounds).fun)
        assert min(found) <= min(known) * (1 + 2e-4)


def test_derivatives_are_the_slopes_of_the_residuals() -> None:
    random = np.random.default_rng(3)
    lights, views = directions(random, 40, 0.5), directions(random, 1, 0.2)
    half = (lights + views) / np.linalg.norm(lights + views, axis=1, keepdims=True)
    packs, rows = np.empty((5, ROWS, 8)), np.empty((30, 8))
    ggx_fit.pack(random.uniform(0.1, 0.4, 40), np.arange(40), lights, half, views, np.zeros(40, int), packs)
    tilts = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))

    def residuals(step: Any) -> Any:
        """[5, 40] derivatives, [40] residuals at a tilted normal."""
        unknowns = np.array([*step[:2], 1.0, *(np.log([0.1, 0.03, 0.2]) + step[2:])])
        unknowns[:3] /= np.linalg.norm(unknowns[:3])
        ggx_fit._residuals(packs, unknowns, *tilts, 0.02, rows)
        weighted = rows.reshape(6, 40)
        off = weighted[5] / np.sqrt(1 - weighted[5] ** 2)
        return weighted[:5] * np.sqrt(1 + off**2), off

    slopes, _ = residuals(np.zeros(5))
    for k, step in enumerate(1e-5 * np.eye(5)):
        numeric = (residuals(step)[1] - residuals(-step)[1]) / 2e-5
        np.testing.assert_allclose(slopes[k], numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())

"""What leans all fitted normals alike, against leans that are known."""

from __future__ import annotations

import numpy as np
from triangle_cases import off_deg, unit

from coupole.reflectance.model_bias import FEWEST, unbiased_normals
from coupole.reflectance.triangle_fit import TriangleMaterials, prior_stiffness

COUNT, NOISE_UM = 1500, 30.0
AREA_MM2 = 0.7
RANDOM = np.random.default_rng(3)
CENTRES = np.concatenate([RANDOM.uniform(0, 30, (COUNT, 2)), np.zeros((COUNT, 1))], axis=1)
TRUTH = unit(np.stack([0.5 * np.sin(CENTRES[:, 0] / 5), 0.5 * np.cos(CENTRES[:, 1] / 6), np.ones(COUNT)], axis=1))
SCAN_RAD = prior_stiffness(np.full(COUNT, AREA_MM2), NOISE_UM)[:, None] ** -0.5
SCANNED = unit(TRUTH + SCAN_RAD * RANDOM.normal(size=(COUNT, 3)))


def materials(normals: np.ndarray) -> TriangleMaterials:
    same = np.full((len(normals), 3), 0.1)
    return TriangleMaterials(normals, same, same, np.full(len(normals), 0.3), np.zeros(len(normals)))


def unbiased(normals: np.ndarray, some: slice = slice(None)) -> np.ndarray:
    areas = np.full(COUNT, AREA_MM2)[some]
    return unbiased_normals(materials(normals[some]), SCANNED[some], CENTRES[some], areas, NOISE_UM)


def test_a_lean_towards_the_camera_is_taken_off() -> None:
    """Three degrees where the surface is seen at 30, by the tangent; the fit's own noise is half a degree."""
    towards = np.array([0.3, 0.0, 1.0]) - np.sum(TRUTH * [0.3, 0.0, 1.0], axis=1)[:, None] * TRUTH
    fitted = unit(TRUTH + 0.09 * towards + np.radians(0.5) / 2**0.5 * RANDOM.normal(size=TRUTH.shape))
    before, after = off_deg(fitted, TRUTH), off_deg(unbiased(fitted), TRUTH)
    assert np.sqrt(np.mean(before**2)) > 2.0
    assert np.sqrt(np.mean(after**2)) < 0.7


def test_what_the_scan_does_not_show_stays() -> None:
    """Bumps that only the pictures have: normals to all sides, as often one way as the other."""
    x, y, _ = CENTRES.T
    bumps = unit(TRUTH + 0.1 * np.stack([np.sin(9 * x), np.cos(9 * y), np.zeros(COUNT)], axis=1))
    kept = unbiased(bumps)
    assert np.sqrt(np.mean(off_deg(bumps, TRUTH) ** 2)) > 4.0
    assert np.sqrt(np.mean(off_deg(kept, bumps) ** 2)) < 0.6


def test_too_few_triangles_keep_their_normals() -> None:
    fitted = unit(TRUTH + np.array([0.1, 0.0, 0.0]))
    few = slice(0, FEWEST - 1)
    np.testing.assert_array_equal(unbiased(fitted, few), fitted[few])

"""What neighbours say of single pixels, against surfaces that are drawn with known spread."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.reflectance.texels.neighbours import lower_half, settle, settle_triangles, tilts_from
from coupole.reflectance.triangle_fit import turned_normals

SIDE = 120
NOISE = np.array([0.02, 0.02, 0.05, 0.3, 0.15])
"""Standard uncertainties of tilts and logarithms, as fits of pixels have them."""


def exact(shape: tuple[int, ...]) -> np.ndarray:
    """Covariances of triangles whose materials are exactly known."""
    return np.zeros((*shape, 15), np.float32)


def settled(truth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviations as fitted, as settled, and their standard uncertainties."""
    random = np.random.default_rng(seed)
    root = np.diag(NOISE) @ np.linalg.cholesky(0.6 * np.eye(5) + 0.4)
    fitted = truth + random.standard_normal(truth.shape) @ root.T
    covariance = lower_half(np.broadcast_to(root @ root.T, (*truth.shape, 5)))
    deviation = fitted.astype(np.float32)
    settle(deviation, covariance, np.ones(truth.shape[:2], bool), exact(truth.shape[:2]))
    return fitted, deviation, np.sqrt(covariance[..., [0, 2, 5, 9, 14]])


def test_pixels_of_a_plain_surface_become_as_their_triangles_are() -> None:
    fitted, deviation, _ = settled(np.zeros((SIDE, SIDE, 5)), 1)
    assert (deviation.std(axis=(0, 1)) < 0.2 * fitted.std(axis=(0, 1))).all()


def test_detail_stays_and_intervals_hold_it() -> None:
    random = np.random.default_rng(2)
    spread = np.array([0.05, 0.08, 0.2, 0.5, 0.1])
    truth = random.standard_normal((SIDE, SIDE, 5)) * spread
    fitted, deviation, u = settled(truth, 3)
    off, before = deviation - truth, fitted - truth
    assert (off.std(axis=(0, 1)) <= before.std(axis=(0, 1))).all()
    held = (np.abs(off) < 1.96 * u).mean(axis=(0, 1))
    assert (held > 0.93).all()
    assert (held < 0.97).all()


def test_a_thin_stroke_on_a_plain_surface_keeps_its_depth() -> None:
    truth = np.zeros((SIDE, SIDE, 5))
    truth[:, 60:62, 2] = -1.0
    _, deviation, _ = settled(truth, 4)
    assert deviation[10:-10, 60:62, 2].mean() == pytest.approx(-1.0, abs=0.06)


def test_what_is_not_fitted_is_not_used_and_not_changed() -> None:
    random = np.random.default_rng(5)
    deviation = random.standard_normal((40, 40, 5)).astype(np.float32)
    covariance = lower_half(np.broadcast_to(np.diag(NOISE**2), (40, 40, 5, 5)))
    fitted = random.uniform(size=(40, 40)) < 0.7
    deviation[~fitted], covariance[~fitted] = np.nan, np.nan
    other, other_covariance = deviation.copy(), covariance.copy()
    other[~fitted], other_covariance[~fitted] = 1e6, 1e6
    settle(deviation, covariance, fitted, exact(fitted.shape))
    settle(other, other_covariance, fitted, exact(fitted.shape))
    np.testing.assert_array_equal(deviation[fitted], other[fitted])
    np.testing.assert_array_equal(covariance[fitted], other_covariance[fitted])
    assert np.isnan(deviation[~fitted]).all()


def test_tilts_turn_the_one_normal_into_the_other() -> None:
    random = np.random.default_rng(6)
    fitted = random.standard_normal((50, 3)) * [0.3, 0.3, 0.0] + [0, 0, 1]
    prior = fitted + 0.01 * random.standard_normal((50, 3))
    fitted, prior = (n / np.linalg.norm(n, axis=1, keepdims=True) for n in (fitted, prior))
    tilts = np.empty((50, 2))
    tilts_from(fitted, prior, tilts)
    back = turned_normals(fitted, -tilts)
    np.testing.assert_allclose(back, prior, atol=2e-5)  # tilts are sines


def test_a_pixel_that_is_as_its_triangle_is_no_surer_than_that() -> None:
    deviation = np.zeros((40, 40, 5), np.float32)
    covariance = lower_half(np.broadcast_to(np.diag(NOISE**2), (40, 40, 5, 5)))
    triangle = np.diag([0.01, 0.01, 0.03, 0.2, 0.1]) ** 2
    of_triangles = lower_half(np.broadcast_to(triangle, (40, 40, 5, 5)))
    settle(deviation, covariance, np.ones((40, 40), bool), of_triangles)
    np.testing.assert_allclose(np.sqrt(covariance[20, 20, 5]), 0.03, rtol=0.05)


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_triangles_of_one_gloss_are_drawn_together_and_kd_follows(spread: float) -> None:
    """Errors of ks and kd are opposite: where ks is drawn to the others, kd loses its error with it. Triangles of
    4 x 4 pixels; with a gloss of its own for each, nothing is drawn far."""
    random = np.random.default_rng(7)
    root = np.zeros((5, 5))
    root[2, 3], root[2, 2], root[3, 3], root[4, 4] = -0.08, 0.01, 0.4, 0.05
    root[0, 0] = root[1, 1] = 0.01
    truth = np.zeros((30, 30, 5))
    truth[..., 3] = spread * random.standard_normal((30, 30))
    triangles = truth + random.standard_normal((30, 30, 5)) @ root.T
    seen = np.repeat(np.repeat(triangles, 4, axis=0), 4, axis=1).astype(np.float32)
    covariance = lower_half(np.broadcast_to(root @ root.T, (120, 120, 5, 5)))
    step = settle_triangles(seen[..., 3:], covariance, np.ones((120, 120), bool), 33)
    off = (seen + step)[::4, ::4] - truth
    u = np.sqrt(covariance[::4, ::4][..., [5, 9]])
    before = triangles - truth
    if spread:
        assert np.abs(off[..., 3] - before[..., 3]).mean() < 0.35 * 0.4
    else:
        assert (off.std(axis=(0, 1))[2:4] < 0.5 * before.std(axis=(0, 1))[2:4]).all()
    held = (np.abs(off[..., 2:4]) < 1.96 * np.hypot(u, [0.01, 0.05])).mean(axis=(0, 1))
    assert (held > 0.9).all()

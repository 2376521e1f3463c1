"""GGX's lobe beside Mitsuba's."""

import math

import numpy as np
import pytest

from coupole.reflectance.ggx import lobe, lobe_density, sample_reflection, shine


def unit(theta_deg: float, phi_deg: float) -> np.ndarray:
    theta, phi = math.radians(theta_deg), math.radians(phi_deg)
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.6, 1.0])
@pytest.mark.parametrize("view", [(0, 0), (35, 10), (70, 200)])
@pytest.mark.parametrize("light", [(5, 40), (40, 190), (75, 20)])
def test_the_lobe_is_that_of_an_independent_renderer(
    alpha: float, view: tuple[float, float], light: tuple[float, float]
) -> None:
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    mirror = mi.load_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha})
    v, l = unit(*view), unit(*light)  # noqa: E741
    place = mi.SurfaceInteraction3f()
    place.wi = mi.Vector3f(*v)
    theirs = mirror.eval(mi.BSDFContext(), place, mi.Vector3f(*l))[0]
    a, b = (0.5 * (math.sqrt(1 + (alpha * math.hypot(d[0], d[1]) / d[2]) ** 2) - 1) for d in (v, l))
    theirs *= (1 + a) * (1 + b) / (1 + a + b)  # theirs hide light and view each by itself; ours both by height
    h = (v + l) / np.linalg.norm(v + l)
    assert l[2] * lobe(l[2], v[2], h[2], alpha)[0] == pytest.approx(theirs, rel=2e-4)


def test_its_derivatives_are_those_of_small_steps() -> None:
    at = np.array([0.6, 0.7, 0.95, 0.3])
    for number, derivative in enumerate(lobe(*at)[1:]):
        step = np.zeros(4)
        step[number] = 1e-6
        assert derivative == pytest.approx((lobe(*(at + step))[0] - lobe(*(at - step))[0]) / 2e-6, rel=1e-6)


def test_pictures_are_made_with_the_same_lobe() -> None:
    for at in ((0.6, 0.7, 0.95, 0.3), (0.1, 0.9, 0.6, 0.05), (1.0, 1.0, 1.0, 1.0)):
        assert shine(*at) == pytest.approx(lobe(*at)[0], rel=1e-12)


@pytest.mark.parametrize("alpha", [0.3, 0.8])
def test_rays_from_a_lobe_go_where_their_density_says(alpha: float) -> None:
    """Sums of directions of 15,000 rays, and the integral of the density over a fine grid of all directions."""
    normal, view = unit(25, 80), unit(75, 120)
    nv = float(normal @ view)
    ways = np.empty((15_000, 3))
    numbers = np.random.default_rng(7).uniform(size=(len(ways), 2))
    for way, (first, second) in zip(ways, numbers, strict=True):
        cosine = sample_reflection(normal, *view, nv, alpha, first, second, way)
        half = (way + view) / np.linalg.norm(way + view)
        assert cosine == pytest.approx(half @ normal, abs=1e-6)
    theta, phi = np.meshgrid((np.arange(150) + 0.5) / 150 * np.pi, np.arange(300) / 300 * 2 * np.pi)
    grid = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    nh = (grid + view) @ normal / np.linalg.norm(grid + view, axis=-1)
    density = np.array([lobe_density(nv, one, alpha) if one > 0 else 0.0 for one in nh.ravel()]).reshape(nh.shape)
    density *= np.sin(theta) * (np.pi / 150) * (2 * np.pi / 300)
    assert density.sum() == pytest.approx(1.0, abs=0.002)
    np.testing.assert_allclose(ways.mean(axis=0), np.einsum("tp,tpk->k", density, grid), atol=0.02)

"""Harmonics of pairs of directions: against SciPy's spherical harmonics, and a lobe that no model of ours has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from triangle_cases import beckmann, noisy_case, unit

from coupole.reflectance.clustering import Pool, empty_pool, fit_pool, pool_samples
from coupole.reflectance.pair_harmonics import count_of, fit_pairs, pair_functions, pair_values
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, model_values

Floats = NDArray[np.float64]
NOISE = 0.02
UP = np.array([[0.0, 0.0, 1.0]])


def directions(count: int, seed: int) -> Floats:
    return unit(np.random.default_rng(seed).standard_normal((count, 3)))


def angles(ways: Floats) -> tuple[Floats, Floats]:
    return np.arccos(ways[:, 2]), np.arctan2(ways[:, 1], ways[:, 0])


@pytest.mark.parametrize("degrees", [2, 5, 17])
def test_functions_are_sums_of_products_of_spherical_harmonics(degrees: int) -> None:
    """Of m and -m, made alike in light and view, with norm 1."""
    lights, views = directions(7, 1), directions(7, 2)
    found = pair_functions(lights, views, degrees)
    assert found.shape == (7, count_of(degrees))
    orders = [(i, k, m) for i in range(degrees) for k in range(i, degrees) for m in range(i + 1)]
    for n, (one, other, m) in list(enumerate(orders))[:: max(1, len(orders) // 60)]:

        def product(a: Floats, b: Floats, first: int = one, second: int = other, m: int = m) -> Floats:
            left, right = sph_harm_y(first, m, *angles(a)), sph_harm_y(second, m, *angles(b))
            return np.asarray((left * np.conj(right)).real * (np.sqrt(2) if m else 1.0))

        both = product(lights, views)
        if one != other:
            both = (both + product(views, lights)) / np.sqrt(2)
        np.testing.assert_allclose(found[:, n], both, atol=1e-12)


def test_functions_are_reciprocal_isotropic_and_mirrored() -> None:
    lights, views = directions(9, 3), directions(9, 4)
    found = pair_functions(lights, views, 6)
    np.testing.assert_allclose(pair_functions(views, lights, 6), found, atol=1e-12)
    turn = Rotation.from_euler("z", 1.1).as_matrix()
    np.testing.assert_allclose(pair_functions(lights @ turn, views @ turn, 6), found, atol=1e-12)
    mirror = np.diag([1.0, -1.0, 1.0])
    np.testing.assert_allclose(pair_functions(lights @ mirror, views @ mirror, 6), found, atol=1e-12)


@pytest.fixture(scope="module")
def glossy() -> tuple[TriangleSamples, Floats]:
    """One material on triangles that face all ways, from eight views; and their normals."""
    samples, normals = noisy_case(1, leds=60)
    azimuth, slant = np.arange(8) * 2.4, np.radians(np.linspace(10, 60, 8))
    ways = np.stack([np.sin(slant) * np.cos(azimuth), np.sin(slant) * np.sin(azimuth), np.cos(slant)], axis=1)
    led_mm, view_of = np.tile(samples.led_mm, (8, 1)), np.repeat(np.arange(8), 60)
    light = unit(led_mm[None] - samples.centres_mm[:, None])
    view = unit((400 * ways)[view_of][None] - samples.centres_mm[:, None])
    values = beckmann(normals[:, None], light, view)
    values *= np.random.default_rng(1).normal(1.0, NOISE, values.shape)
    low = np.minimum(np.sum(normals[:, None] * light, axis=2), np.sum(normals[:, None] * view, axis=2)) < 0.1
    values[low] = np.nan
    made = replace(
        samples, values=values.astype(np.float32), led_mm=led_mm, view_of=view_of, cameras_mm=400 * ways
    )
    return made, normals


NEW_VIEW = 3


def pooled(samples: TriangleSamples, normals: Floats) -> Pool:
    """Of all lights but each sixth, and all views but one."""
    pool = empty_pool(1, 3)
    used = ~new_light(samples) & (samples.view_of != NEW_VIEW)
    numbers, members = np.zeros(len(normals), np.int64), np.array([len(normals)])
    pool_samples(pool, samples, used, normals, numbers, members, np.random.default_rng(0))
    return pool


def new_light(samples: TriangleSamples) -> NDArray[np.bool_]:
    return np.arange(len(samples.led_mm)) % 6 == 0


def missed(samples: TriangleSamples, made: NDArray[np.float32]) -> Floats:
    """[2] of f cos_i, relative to its mean: under lights left out, and under those from a view left out."""
    off = np.abs(made - samples.values) / np.nanmean(samples.values)
    beyond = samples.view_of == NEW_VIEW
    return np.array([np.nanmean(off[:, new_light(samples) & part]) for part in (~beyond, beyond)])


def test_lights_and_a_view_that_were_left_out_are_told(glossy: tuple[TriangleSamples, Floats]) -> None:
    """To little more than noise, where GGX misses the form of the lobe."""
    samples, normals = glossy
    pool, all_alike = pooled(samples, normals), np.zeros(len(normals), np.int64)
    off = {d: missed(samples, pair_values(samples, normals, all_alike, fit_pairs(pool, d))) for d in (3, 10)}
    of_noise = NOISE * np.sqrt(2 / np.pi)
    assert (off[10] < 1.25 * of_noise).all()
    assert (off[3] > 3 * off[10]).all()
    start = TriangleMaterials(UP, np.full((1, 3), 0.1), np.full((1, 3), 0.04), np.array([0.3]), np.zeros(1))
    material = replace(fit_pool(pool, start).at(all_alike), normals=normals)
    assert (off[10] < 0.7 * missed(samples, model_values(samples, material))).all()


def test_without_samples_there_is_no_reflectance(glossy: tuple[TriangleSamples, Floats]) -> None:
    samples, normals = glossy
    coefficients = fit_pairs(empty_pool(1, 3), 4)
    assert np.isnan(coefficients).all()
    for number in (0, -1):
        made = pair_values(samples, normals, np.full(len(normals), number), coefficients)
        assert np.isnan(made).all()

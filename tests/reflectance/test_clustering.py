"""Clusters of triangles whose material varies, with normals that are off, by samples of a lobe that no fit has."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from triangle_cases import COUNT, noisy_case, off_deg

from coupole.reflectance.clustering import (
    MOST_POOLED,
    clusters_of,
    empty_pool,
    fit_pool,
    looks,
    nearest_cluster,
    pool_samples,
)
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, fit_triangles, model_values

HELD_OUT = np.arange(240) % 10 == 4


@pytest.fixture(scope="module")
def varying() -> tuple[TriangleSamples, TriangleMaterials, np.ndarray]:
    """Samples whose reflectance varies by a factor of 3 over the triangles, continuously; fits; the factors."""
    samples, truth = noisy_case(2)
    factors = np.linspace(0.5, 1.5, COUNT)
    many = replace(samples, values=(samples.values * factors[:, None, None]).astype(np.float32))
    materials = fit_triangles(many, ~HELD_OUT, 30.0)
    assert np.median(off_deg(materials.normals, truth)) < 1.0
    return many, materials, factors


def pooled(samples: TriangleSamples, materials: TriangleMaterials, cluster: np.ndarray) -> TriangleMaterials:
    members = np.bincount(cluster)
    pool = empty_pool(len(members), 3)
    pool_samples(pool, samples, ~HELD_OUT, materials.normals, cluster, members, np.random.default_rng(0))
    assert (pool.counts <= MOST_POOLED).all()
    np.testing.assert_allclose(np.linalg.norm(pool.lights[0, : pool.counts[0]], axis=1), 1.0, rtol=1e-5)
    first = materials.at(np.array([np.flatnonzero(cluster == number)[0] for number in range(len(members))]))
    return fit_pool(pool, first)


def mae(samples: TriangleSamples, materials: TriangleMaterials) -> float:
    off = model_values(samples, materials)[:, HELD_OUT] - samples.values[:, HELD_OUT]
    return float(np.nanmean(np.abs(off)))


def test_a_few_materials_stand_for_all(varying: tuple[TriangleSamples, TriangleMaterials, np.ndarray]) -> None:
    samples, materials, factors = varying
    cluster = clusters_of(looks(materials), 12)
    number = cluster.max() + 1
    assert 9 <= number <= 12
    assert set(cluster) == set(range(number))
    spread = [np.ptp(factors[cluster == one]) for one in range(number)]
    assert max(spread) < 0.4  # of 1: those that look alike are together
    of_clusters = pooled(samples, materials, cluster)
    shared = replace(of_clusters.at(cluster), normals=materials.normals)
    assert mae(samples, shared) < 1.7 * mae(samples, materials)  # the paper's ratio
    one = pooled(samples, materials, np.zeros(COUNT, np.int64))
    share = one.kd[0] / np.median(materials.kd, axis=0)
    assert ((share > 0.9) & (share < 1.35)).all()  # 0.6 were it of the first triangles alone
    alike = replace(one.at(np.zeros(COUNT, np.int64)), normals=materials.normals)
    assert mae(samples, alike) > 4 * mae(samples, materials)


def test_pooled_samples_give_the_material_that_they_share(
    varying: tuple[TriangleSamples, TriangleMaterials, np.ndarray],
) -> None:
    """Triangles of one material, from starts that are far off; with the mesh's normals the fit is worse."""
    samples, _, factors = varying
    alike = replace(samples, values=(samples.values / factors[:, None, None]).astype(np.float32))
    own = fit_triangles(alike, ~HELD_OUT, 30.0)
    start = replace(own, kd=2.0 * own.kd, ks=0.3 * own.ks, alpha=0.6 + 0 * own.alpha)
    cluster = np.zeros(COUNT, np.int64)
    found = pooled(alike, start, cluster)
    np.testing.assert_allclose(found.kd[0], np.median(own.kd, axis=0), rtol=0.03)
    np.testing.assert_allclose(found.alpha[0], np.median(own.alpha), rtol=0.1)
    by_mesh = pooled(alike, replace(start, normals=samples.normals), cluster)
    assert by_mesh.residual[0] > 1.5 * found.residual[0]


def test_a_triangle_with_few_samples_finds_what_it_looks_like(
    varying: tuple[TriangleSamples, TriangleMaterials, np.ndarray],
) -> None:
    samples, materials, _ = varying
    true_normals = replace(samples, normals=materials.normals)
    few = replace(true_normals, values=np.where(np.arange(240)[:, None] % 16 == 1, samples.values, np.nan))
    found = nearest_cluster(few, ~HELD_OUT, materials, 4)
    known = found >= 0
    assert known.sum() > COUNT // 2
    brightness = materials.kd.mean(axis=1)
    off = brightness[found[known]] / brightness[known] - 1
    assert np.median(np.abs(off)) < 0.03
    assert (nearest_cluster(few, ~HELD_OUT, materials, 100) == -1).all()


def test_memory_does_not_grow_with_triangles_times_clusters() -> None:
    """400,000 triangles in 1,000 clusters would be 3.3 GB of distances."""
    features = np.random.default_rng(3).normal(size=(150_000, 6))
    tracemalloc.start()
    try:
        cluster = clusters_of(features, 200)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 120e6
    centres = np.stack([features[cluster == number].mean(axis=0) for number in range(cluster.max() + 1)])
    some = np.arange(0, len(features), 100)
    apart = np.linalg.norm(features[some, None] - centres, axis=2)
    assert np.median(apart[np.arange(len(some)), cluster[some]] / apart.min(axis=1)) < 1.01

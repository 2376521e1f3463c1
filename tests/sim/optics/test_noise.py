"""The random numbers of the simulated sensor: the right generator, the right distributions, the right tails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from lazily import lazily
from numpy.typing import NDArray
from scipy import special

from coupole.kernels import kernel
from sim.optics import noise

stats: Any = lazily("scipy.stats")
FRAME = 3
TABLES = (noise.INVERSE_NORMAL, noise.SMALL_MEANS, noise.SMALL_STARTS)


@kernel
def words(n: int, frame: int, key: int) -> NDArray[np.uint32]:
    out = np.empty((n, 2), np.uint32)
    for i in range(n):
        out[i, 0], out[i, 1] = noise.philox(i, frame, key)
    return out


@kernel
def normals(random: NDArray[np.uint32], table: NDArray[np.float32]) -> NDArray[np.float32]:
    out = np.empty(len(random), np.float32)
    for i in range(len(random)):
        out[i] = noise.normal(random[i], table)
    return out


@kernel
def counts(
    mean: float,
    random: NDArray[np.uint32],
    table: NDArray[np.float32],
    small: NDArray[np.uint32],
    starts: NDArray[np.uint8],
) -> NDArray[np.float32]:
    out = np.empty(len(random), np.float32)
    for i in range(len(random)):
        if mean < noise.POISSON_EXACT_BELOW:
            out[i] = noise.poisson_exact(np.float32(mean), random[i], small, starts)
        else:
            out[i] = noise.poisson_quantile(np.float32(mean), noise.normal(random[i], table))
    return out


def even_words(n: int) -> NDArray[np.uint32]:
    """Words spread evenly over all 32 bits, each with both signs (the last bit): moments without chance."""
    half = ((np.arange(n // 2, dtype=np.float64) + 0.5) * (2.0**33 / n)).astype(np.uint32)
    return np.concatenate([half & ~np.uint32(1), half | np.uint32(1)])


def test_philox_is_the_published_generator() -> None:
    def rounds(counter: int, frame: int, key: int, n: int) -> tuple[int, int]:
        for _ in range(n):
            product = counter * 0xD256D193
            counter, frame = (product >> 32) ^ key ^ frame, product % 2**32
            key = (key + 0x9E3779B9) % 2**32
        return counter, frame

    # The known answer of Random123 for 10 rounds vouches for the rounds written out here.
    assert rounds(0, 0, 0, 10) == (0xFF1DAE59, 0x6CD10DF2)
    ours = words(100, FRAME, np.uint32(0x9ABCDEF1))
    assert [tuple(pair) for pair in ours.tolist()] == [rounds(i, FRAME, 0x9ABCDEF1, 7) for i in range(100)]


def test_the_normal_is_the_quantile_of_its_bits_into_the_tails() -> None:
    random = np.concatenate(
        [np.arange(4096, dtype=np.uint32), even_words(200_000), ~np.arange(4096, dtype=np.uint32)]
    )
    quantile = special.ndtri(((random >> 1) + 0.5) * 2.0**-32)
    expected = np.where(random & 1, quantile, -quantile)
    assert np.abs(expected).max() > 6.0
    assert normals(random, noise.INVERSE_NORMAL) == pytest.approx(expected, abs=2e-5)


def test_normals_of_a_frame_are_normal_and_independent(scale: Callable[[int, int], int]) -> None:
    n = scale(1_000_000, 20_000_000)
    pairs = words(n, FRAME, noise.key(1, 0))
    first, second = (normals(pairs[:, i].copy(), noise.INVERSE_NORMAL).astype(float) for i in (0, 1))
    other_frame = normals(words(n, FRAME + 1, noise.key(1, 0))[:, 0].copy(), noise.INVERSE_NORMAL).astype(float)
    sigma = 1.0 / np.sqrt(n)
    assert abs(first.mean()) < 4.5 * sigma
    assert abs(first.var() - 1.0) < 4.5 * np.sqrt(2.0) * sigma
    assert abs(stats.skew(first)) < 4.5 * np.sqrt(6.0) * sigma
    assert abs(stats.kurtosis(first)) < 4.5 * np.sqrt(24.0) * sigma
    beyond = np.count_nonzero(np.abs(first) > 4.0)
    expected = n * 2.0 * stats.norm.sf(4.0)
    assert abs(beyond - expected) < 4.5 * np.sqrt(expected)
    for a, b in ((first, second), (first, other_frame), (first[1:], first[:-1])):
        assert abs(np.corrcoef(a, b)[0, 1]) < 4.5 * sigma


@pytest.mark.parametrize("mean", [0.0, 0.03, 0.125, 0.8, 3.3, 11.99, 15.9])
def test_small_counts_are_poisson_exactly(mean: float) -> None:
    drawn = counts(mean, even_words(400_000), *TABLES)
    share = np.bincount(drawn.astype(int), minlength=80) / len(drawn)
    assert 0.5 * np.abs(share - stats.poisson.pmf(np.arange(len(share)), mean)).sum() < 1e-4


@pytest.mark.parametrize("mean", [16.0, 20.5, 100.0, 13_000.0])
def test_greater_counts_are_whole_and_poisson_within_the_stated_bound(mean: float) -> None:
    drawn = counts(mean, even_words(1_000_000), *TABLES).astype(float)
    assert np.array_equal(drawn, np.floor(drawn))
    assert drawn.mean() == pytest.approx(mean, rel=1e-5)
    assert drawn.var() == pytest.approx(mean, rel=2e-4)
    assert stats.skew(drawn) * np.sqrt(mean) == pytest.approx(1.0, abs=0.02)
    if mean <= 100.0:
        share = np.bincount(drawn.astype(int), minlength=400) / len(drawn)
        assert 0.5 * np.abs(share - stats.poisson.pmf(np.arange(len(share)), mean)).sum() < 5e-4


def test_keys_differ_by_seed_and_kind() -> None:
    keys = {int(noise.key(seed, kind)) for seed in range(-50, 50) for kind in range(8)}
    assert len(keys) == 800

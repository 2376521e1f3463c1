"""Random numbers as pure functions of their index: Philox, normal and Poisson draws for kernels.

A draw is identified by a key (seed, kind of noise) and a counter (pixel, frame). There is no state, so a frame is
the same whatever the number of threads, the order of frames, or earlier draws.
"""

from __future__ import annotations

from statistics import NormalDist

import numba
import numpy as np
from numpy.typing import NDArray

POISSON_EXACT_BELOW = 16.0
"""Means below this are drawn exactly; above it, an integer Cornish-Fisher quantile is used."""

_MEANS_PER_ELECTRON, _COUNTS = 8, 72
_PER_OCTAVE_BITS = 6
_MANTISSA_BITS = 23
_SHIFT = _MANTISSA_BITS - _PER_OCTAVE_BITS
_OCTAVES = 33
_FIRST = (127 - _OCTAVES) << _PER_OCTAVE_BITS
"""Index of 2^-33, below which 31 random bits have no probability."""


def key(seed: int, kind: int) -> np.uint32:
    """32-bit key of one kind of noise under one seed of up to 64 bits (SplitMix64: Steele, Lea, Flood 2014)."""
    x = (seed + (kind + 1) * 0x9E3779B97F4A7C15) % 2**64
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB % 2**64
    return np.uint32((x ^ (x >> 31)) >> 32)


def _inverse_normal() -> NDArray[np.float32]:
    """[octaves * 64, 2] offset and slope of the normal quantile of p in 0 to 1/2, linear between 64 nodes per
    octave.

    Indexed by the leading bits of p as float32, so the tail has as many nodes per octave as the middle. The
    chord's greatest error is 1.2e-5 standard deviations.
    """
    nodes = 1 << _PER_OCTAVE_BITS
    edges = np.ldexp(1.0 + np.arange(nodes) / nodes, np.arange(-_OCTAVES, 0)[:, None]).ravel()
    edges = np.append(edges[edges < 0.5], 0.5)
    quantile = np.array([NormalDist().inv_cdf(p) for p in edges])
    slope = np.diff(quantile) / np.diff(edges)
    return np.stack([quantile[:-1] - slope * edges[:-1], slope], axis=1).astype(np.float32)


INVERSE_NORMAL = _inverse_normal()


def _small_means() -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
    """Return the probability of fewer than n counts [128, 72] for means in steps of 1/8, in units of 2^-32. Also
    return a table [128, 256] of the counts at which the search begins, for each value of a word's upper 8 bits.
    """
    means = np.arange(int(POISSON_EXACT_BELOW) * _MEANS_PER_ELECTRON)[:, None] / _MEANS_PER_ELECTRON
    factors = np.concatenate([np.exp(-means), means / np.arange(1, _COUNTS - 1)], axis=1)
    fewer = np.cumsum(np.cumprod(factors, axis=1), axis=1) * 2.0**32
    cumulative = np.minimum(np.rint(np.pad(fewer, ((0, 0), (1, 0)))), 2.0**32 - 1).astype(np.uint32)
    upper = np.arange(256, dtype=np.uint32) << np.uint32(24)
    start = np.stack([np.searchsorted(row, upper, side="right") - 1 for row in cumulative]).astype(np.uint8)
    return cumulative, start


SMALL_MEANS, SMALL_STARTS = _small_means()


@numba.njit(inline="always")
def philox(counter, frame, seed):  # type: ignore[no-untyped-def]
    """Two random uint32 from a 64-bit counter (pixel, frame) and a 32-bit key: Philox 2x32 with 7 rounds.

    Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011; 7 rounds are the fewest
    that pass BigCrush there.
    """
    left_word, right, k = np.uint32(counter), np.uint32(frame), np.uint32(seed)
    for _ in range(7):
        product = np.uint64(left_word) * np.uint64(0xD256D193)
        left_word = np.uint32(product >> np.uint64(32)) ^ k ^ right
        right = np.uint32(product)
        k = np.uint32(k + np.uint32(0x9E3779B9))
    return left_word, right


@numba.njit(inline="always")
def normal(word, table):  # type: ignore[no-untyped-def]
    """Standard normal from 32 random bits, by inversion: tails to 6.2 standard deviations."""
    p = (np.float32(word >> np.uint32(1)) + np.float32(0.5)) * np.float32(2.0**-32)
    at = (np.float32(p).view(np.int32) >> np.int32(_SHIFT)) - np.int32(_FIRST)
    at = min(at, np.int32(len(table) - 1))
    low = table[at, 0] + table[at, 1] * p
    return low if word & np.uint32(1) else -low


@numba.njit(inline="always")
def poisson_quantile(mean, z):  # type: ignore[no-untyped-def]
    """Integer distributed as Poisson(mean), from a standard normal `z`, for means of 16 and more.

    Cornish and Fisher (1937), third order; the variance is reduced by 1/12 for the rounding (Sheppard). At a mean
    of 16 the distance in total variation is 3e-4 and the variance right to 2e-5; both decrease with the mean.
    """
    mean = np.float32(mean)
    root = np.sqrt(mean - np.float32(1.0 / 12.0))
    third = (z - z * z * z) / (np.float32(72.0) * root)
    count = np.floor(mean + root * z + (z * z - np.float32(1.0)) * np.float32(1.0 / 6.0) + third + np.float32(0.5))
    return max(count, np.float32(0.0))


@numba.njit(inline="always")
def poisson_exact(mean, word, cumulative, start):  # type: ignore[no-untyped-def]
    """Poisson count from 32 random bits, for means below 16: the sum of two counts, each by inversion.

    The mean of the first count is the next lower mean in the tables `SMALL_MEANS` and `SMALL_STARTS`. The position
    of the word between two of its steps is a random number too. It draws the second count, for the remainder of
    the mean; this count is nearly always 0. A loop from 0 with the mean itself is four times slower, because its
    length is unpredictable.
    """
    row = np.int32(mean * np.float32(_MEANS_PER_ELECTRON))
    count = np.int32(start[row, word >> np.uint32(24)])
    while count < _COUNTS - 2 and word >= cumulative[row, count + 1]:
        count += 1
    low = cumulative[row, count]
    rest = mean - np.float32(row) * np.float32(1.0 / _MEANS_PER_ELECTRON)
    none = 1.0 - rest * (1.0 - rest * (0.5 - rest * (1.0 / 6.0 - rest * (1.0 / 24.0))))
    remainder = np.float64(word - low) + 0.5
    probability = np.float64(cumulative[row, count + 1] - low) * none
    more = np.int32(0)
    while remainder > probability and more < 12:
        remainder -= probability
        more += 1
        probability *= rest / more
    return np.float32(count + more)

"""Smaller and smaller levels of a map, as textures are stored for viewers that show a surface from afar.

A level has half the width and height of the one before, rounded down, to 1 x 1. Its texels are averages of the
quantities that the codes represent: linear light for colours, directions for normals. Each texel counts by its
area, also where a side is odd. Texels between the charts have no weight, and get the values of the next smaller
level, so that no level shows black at a seam.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.srgb import linear_from_srgb, srgb

Codes = NDArray[np.uint8]
Singles = NDArray[np.float32]

_BLOCK = 512
"""Number of rows that are averaged together."""
_CODES = np.arange(256) / 255.0


@dataclass(frozen=True)
class Meaning:
    """Meaning of a map's codes: the quantity that is averaged."""

    value_of_code: Singles
    """[256] value of each code."""
    encode: Callable[[Singles], Singles]
    """Codes of values [..., c], 0 to 1."""


def _unit_codes(directions: Singles) -> Singles:
    length = np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-6)
    return np.asarray(0.5 * directions / length + 0.5, np.float32)


COLOUR = Meaning(linear_from_srgb(_CODES).astype(np.float32), srgb)
"""sRGB; the averages are of linear light."""
SHARE = Meaning(_CODES.astype(np.float32), lambda values: values)
"""Values from 0 to 1."""
DIRECTION = Meaning((2.0 * _CODES - 1.0).astype(np.float32), _unit_codes)
"""Directions as (n + 1) / 2 of unit vectors n. Averages are made unit vectors again."""


def mip_levels(codes: Codes, is_known: NDArray[np.bool_], meaning: Meaning) -> Iterator[Codes]:
    """Levels of a map [h, w, c], the largest first; `is_known` [h, w] where it shows something. At least one texel
    must be known."""
    smaller = [_halved_codes(codes, is_known, meaning)] if max(is_known.shape) > 1 else []
    while smaller and max(smaller[-1][1].shape) > 1:
        smaller.append(_next_level(*smaller[-1]))
    for level in range(len(smaller) - 2, -1, -1):
        values, weights = smaller[level]
        _fill(values, weights > 0.0, smaller[level + 1][0])
    largest = codes.copy()
    if smaller:
        _fill(largest, is_known, _codes_of(smaller[0][0], meaning))
    yield largest
    for values, _ in smaller:
        yield _codes_of(values, meaning)


def _codes_of(values: Singles, meaning: Meaning) -> Codes:
    codes: Codes = np.rint(255.0 * np.clip(meaning.encode(values), 0.0, 1.0)).astype(np.uint8)
    return codes


def _halved_codes(codes: Codes, is_known: NDArray[np.bool_], meaning: Meaning) -> tuple[Singles, Singles]:
    """Values and weights of the second level, made from blocks of rows, as the first one may be a gigabyte."""
    blocks = []
    for first in range(0, len(codes), _BLOCK):
        rows = slice(first, first + _BLOCK)
        weights = is_known[rows].astype(np.float32)
        sums = meaning.value_of_code[codes[rows]] * weights[..., None]
        blocks.append((_halved_along(sums, 1), _halved_along(weights, 1)))
    return _means(*(_halved_along(np.concatenate(parts), 0) for parts in zip(*blocks, strict=True)))


def _next_level(values: Singles, weights: Singles) -> tuple[Singles, Singles]:
    """Values and weights, the known share of each texel's area, of the next level."""
    sums, shares = (
        _halved_along(_halved_along(of_texels, 1), 0) for of_texels in (values * weights[..., None], weights)
    )
    return _means(sums, shares)


def _means(sums: Singles, shares: Singles) -> tuple[Singles, Singles]:
    is_known = shares > 0.0
    sums[is_known] /= shares[is_known][:, None]
    return sums, shares


def _halved_along(values: Singles, axis: int) -> Singles:
    """Means of areas along an axis of n texels, of which n // 2 remain; for n = 1, the one texel remains."""
    along = np.moveaxis(values, axis, 0)
    half = len(along) // 2
    if half == 0:
        return values
    if len(along) % 2 == 0:
        means = 0.5 * (along[0::2] + along[1::2])
    else:  # n = 2 m + 1: each new texel is (2 + 1 / m) old ones wide, and shares one with its neighbour
        place = np.arange(half, dtype=np.float32).reshape(-1, *([1] * (along.ndim - 1)))
        means = (half - place) * along[0:-2:2] + half * along[1::2] + (place + 1) * along[2::2]
        means /= np.float32(len(along))
    return np.moveaxis(means, 0, axis)


def _fill(values: NDArray[Any], is_known: NDArray[np.bool_], smaller: NDArray[Any]) -> None:
    """Fill places where nothing is known with the texel of the smaller level."""
    rows, columns = np.nonzero(~is_known)
    height, width = smaller.shape[:2]
    values[rows, columns] = smaller[np.minimum(rows // 2, height - 1), np.minimum(columns // 2, width - 1)]

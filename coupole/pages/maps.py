"""Maps of values and pictures for the eye, as figures of a page."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.pages import palettes
from coupole.pages.page_parts import Map, Picture

WIDTH_PX = 480
"""Largest width of a map. If a map is wider, only every second pixel is shown, or fewer."""
GAMMA = 2.2
BRIGHTEST = 0.999
"""Quantile of a picture that is shown as white."""
_PNG_LEVEL = 4
"""Level of zlib. Maps are about 3 % larger than by level 9, which takes seven times as long."""


def value_map(
    title: str, values: NDArray[Any], unit: str, high: float, *, low: float = 0.0, palette: str = "amount"
) -> Map:
    """Return a map of values [h, w] from `low` to `high` in a unit. NaN has no colour."""
    return _map_of(title, _some_pixels(values), unit, (low, high), palette)


def shaded_map(
    title: str,
    values: NDArray[Any],
    shade: NDArray[Any],
    unit: str,
    high: float,
    *,
    low: float = 0.0,
    palette: str = "amount",
) -> Map:
    """Return a map as wide as the page, of values [h, w] on a solid. `shade` [h, w] is the brightness of the solid
    from 0 to 1."""
    from PIL import Image

    black = np.zeros((*shade.shape, 2), np.uint8)
    black[..., 1] = np.rint(255 * (1 - np.clip(np.nan_to_num(shade, nan=1.0), 0, 1)))
    value_figure = _map_of(title, np.asarray(values, np.float64), unit, (low, high), palette)
    return replace(value_figure, shade_png=_png(Image.fromarray(black, "LA")), is_broad=True)


def _map_of(
    title: str, pixel_values: NDArray[np.float64], unit: str, ends: tuple[float, float], palette: str
) -> Map:
    from PIL import Image

    low, high = ends
    is_known: NDArray[np.bool_] = np.isfinite(pixel_values)
    share = np.clip((np.where(is_known, pixel_values, low) - low) / (high - low), 0, 1)
    index = np.where(is_known, 1 + np.rint(share * (palettes.LEVELS - 1)), 0).astype(np.uint8)
    image = Image.fromarray(index, "P")
    image.putpalette(bytes(3) + palettes.table(palette).tobytes())
    is_cut = bool(is_known.any() and (np.max(pixel_values[is_known]) > high))
    return Map(title, _png(image, transparency=0), unit, low, high, palette, is_cut=is_cut)


def colour_map(
    title: str,
    values: NDArray[Any],
    names: Sequence[str],
    high: float,
    *,
    low: float = 0.0,
    unit: str = "",
    gamma: float = 1.0,
) -> Map:
    """Return a map of three values [h, w, 3], shown as red, green and blue. A pixel with a NaN has no colour."""
    from PIL import Image

    pixel_values = _some_pixels(values)
    is_known = np.asarray(np.isfinite(pixel_values).all(axis=2))
    share = np.clip((np.where(is_known[..., None], pixel_values, low) - low) / (high - low), 0, 1) ** (1 / gamma)
    pixels = np.concatenate([np.rint(255 * share), 255.0 * is_known[..., None]], axis=2).astype(np.uint8)
    return Map(title, _png(Image.fromarray(pixels)), unit, low, high, names=tuple(names), gamma=gamma)


def eye_map(title: str, picture: NDArray[Any], white: float | None = None, unit: str = "") -> Map:
    """Return a picture [h, w, 3] or [h, w] for the eye, by a power of 2.2. The value `white`, or otherwise the
    brightest part, is white."""
    three = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    finite_values = three[np.isfinite(three)]
    high = white or max(float(np.quantile(finite_values, BRIGHTEST)) if finite_values.size else 1.0, 1e-12)
    return colour_map(title, three, ("red", "green", "blue"), high, unit=unit, gamma=GAMMA)


def normal_map(title: str, normals: NDArray[Any]) -> Map:
    """Return a map of unit vectors [h, w, 3]."""
    return colour_map(title, normals, ("x", "y", "z"), 1.0, low=-1.0)


def colour_picture(title: str, shares: NDArray[Any]) -> Picture:
    """Return a picture of shares [h, w, 3] from 0 to 1. Its colours stand for no values."""
    return Picture(title, picture_png(np.rint(255 * np.clip(_some_pixels(shares), 0, 1)).astype(np.uint8)))


def picture_png(codes: NDArray[np.uint8]) -> bytes:
    """Return a picture [h, w] or [h, w, 3] as PNG."""
    from PIL import Image

    return _png(Image.fromarray(codes))


def _some_pixels(values: NDArray[Any]) -> NDArray[np.float64]:
    step = -(-values.shape[1] // WIDTH_PX)
    return np.asarray(values[::step, ::step], np.float64)


def _png(image: Any, **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=_PNG_LEVEL, **options)
    return buffer.getvalue()

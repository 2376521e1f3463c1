"""Pictures and figures of RAW frames for preview; no data or measurement depends on them."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_GAMMA = 1 / 2.2
BINS = 128
_SATURATED, _SHARP = (255, 0, 0), (0, 255, 60)
_SHARP_GRADIENT = 0.25
"""Relative change of brightness from one cell to the next. Above it an edge is in focus."""
_BEYOND_NOISE = 5.0
"""Multiple of the standard error of a frame's mean product of gradients. Below it, noise may have caused the
value."""
_CLIPPED = 0.001
"""Share of a region's pixels at full scale. Above this share, the region cannot give the white point."""
_DARK = 0.02
"""Share of full scale. Below it, an edge is noise."""


@dataclass(frozen=True)
class Coding:
    """Pattern and levels of a frame."""

    pattern: str
    """Bayer pattern 2 x 2 from the top left, or MONO."""
    black_dn: int
    white_dn: int


@dataclass(frozen=True)
class Figures:
    """Figures of a RAW frame."""

    histograms: dict[str, list[int]]
    """Numbers of pixels by channel (R, G1, G2, B; Y for MONO), in `BINS` equal steps from 0 to full scale."""
    saturated: dict[str, float]
    """Share of pixels at full scale, by channel."""
    brightest: float
    """99.9 % quantile, share of the range above black."""
    sharpness: float
    """Mean squared gradient over mean square. Both squares are products of the two green pixels of each cell,
    whose noise is independent. So noise adds nothing in the mean. A value that noise alone may have caused counts
    as 0. Values can be compared only for the same scene under the same light."""


def develop(
    raw: NDArray[np.uint16],
    *,
    pattern: str,
    black_dn: int,
    white_dn: int,
    gains: Sequence[float] = (1.0, 1.0, 1.0),
) -> NDArray[np.uint8]:
    """Return a preview [h/2, w/2, 3] of a RAW frame: one pixel for each Bayer cell, times `gains` of R, G, B, with
    a gamma of 2.2."""
    shares = np.clip((raw.astype(np.float32) - black_dn) / (white_dn - black_dn), 0, 1)
    cell = [shares[0::2, 0::2], shares[0::2, 1::2], shares[1::2, 0::2], shares[1::2, 1::2]]
    letters = pattern if pattern != "MONO" else "GGGG"
    planes = []
    for colour, gain in zip("RGB", gains, strict=True):
        samples = [
            plane
            for plane, letter in zip(cell, letters, strict=True)
            if letter in (colour, "G" * (pattern == "MONO"))
        ]
        planes.append(np.minimum(gain * np.mean(samples, axis=0), 1.0))
    picture: NDArray[np.uint8] = (255 * np.stack(planes, axis=-1) ** _GAMMA + 0.5).astype(np.uint8)
    return picture


def png(picture: NDArray[np.uint8], width_px: int | None = None) -> bytes:
    """A picture as PNG, scaled down to `width_px` if given."""
    from PIL import Image

    image = Image.fromarray(picture)
    if width_px and image.width > width_px:
        image = image.resize((width_px, max(1, image.height * width_px // image.width)))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def channels(raw: NDArray[np.uint16], pattern: str) -> dict[str, NDArray[np.uint16]]:
    """Planes [h/2, w/2] of the Bayer cell by name: R, G1, G2, B; the whole frame as Y for MONO."""
    if pattern == "MONO":
        return {"Y": raw}
    planes: dict[str, NDArray[np.uint16]] = {}
    greens = 0
    for place, letter in enumerate(pattern):
        greens += letter == "G"
        planes[letter if letter != "G" else f"G{greens}"] = raw[place // 2 :: 2, place % 2 :: 2]
    return dict(sorted(planes.items(), key=lambda item: ("RGB".index(item[0][0]), item[0])))


def figures(raw: NDArray[np.uint16], coding: Coding) -> Figures:
    """Histograms, saturation and sharpness of a RAW frame."""
    planes = channels(raw, coding.pattern)
    step = coding.white_dn + 1
    quantile = float(np.quantile(raw[:: max(1, raw.shape[0] // 512)], 0.999))
    return Figures(
        {
            name: np.bincount(plane.ravel().astype(np.int64) * BINS // step, minlength=BINS).tolist()
            for name, plane in planes.items()
        },
        {name: float(np.mean(plane >= coding.white_dn)) for name, plane in planes.items()},
        (quantile - coding.black_dn) / (coding.white_dn - coding.black_dn),
        _sharpness(*_two_greens(raw, coding)),
    )


def _sharpness(plane: NDArray[np.float32], other_plane: NDArray[np.float32]) -> float:
    """Return the sharpness of two planes [h, w] of the same scene with independent noise; 0 if there is only
    noise."""
    products = np.diff(plane, axis=0)[:, 1:] * np.diff(other_plane, axis=0)[:, 1:]
    products += np.diff(plane, axis=1)[1:] * np.diff(other_plane, axis=1)[1:]
    energy, noise = float(products.mean()), float(products.std()) / math.sqrt(products.size)
    level = float(np.mean(plane * other_plane))
    return energy / level if energy > _BEYOND_NOISE * noise and level > 0 else 0.0


def white_point(raw: NDArray[np.uint16], coding: Coding) -> tuple[float, float, float] | None:
    """Return gains of R, G, B that make the mean of a region neutral, with green unchanged. None if the region is
    saturated, too dark, or has no colours.
    """
    planes = channels(raw, coding.pattern)
    span = coding.white_dn - coding.black_dn
    mean = {name: (float(plane.mean()) - coding.black_dn) / span for name, plane in planes.items()}
    full = max(float(np.mean(plane >= coding.white_dn)) for plane in planes.values())
    if "R" not in mean or full > _CLIPPED or min(mean.values()) < _DARK:
        return None
    green = 0.5 * (mean["G1"] + mean["G2"])
    return green / mean["R"], 1.0, green / mean["B"]


def loupe(raw: NDArray[np.uint16], coding: Coding, gains: Sequence[float] = (1.0, 1.0, 1.0)) -> bytes:
    """Return a region of a RAW frame as PNG, with one pixel for each pixel of the sensor. The region begins on a
    Bayer cell. Each pixel has its own value; its two other colours are the colours of its cell."""
    cells = develop(raw, pattern=coding.pattern, black_dn=coding.black_dn, white_dn=coding.white_dn, gains=gains)
    picture = np.repeat(np.repeat(cells, 2, axis=0), 2, axis=1)
    letters = coding.pattern if coding.pattern != "MONO" else "GGGG"
    for place, letter in enumerate(letters):
        at = np.s_[place // 2 :: 2, place % 2 :: 2]
        channel = "RGB".index(letter)
        share = np.clip((raw[at].astype(np.float32) - coding.black_dn) / (coding.white_dn - coding.black_dn), 0, 1)
        codes = (255 * np.minimum(gains[channel] * share, 1.0) ** _GAMMA + 0.5).astype(np.uint8)
        for colour in range(3) if coding.pattern == "MONO" else (channel,):
            picture[(*at, colour)] = codes
    return png(picture)


def look(
    raw: NDArray[np.uint16],
    coding: Coding,
    width_px: int,
    *,
    saturation: bool,
    focus: bool,
    gains: Sequence[float] = (1.0, 1.0, 1.0),
) -> bytes:
    """Return a JPEG of a RAW frame, at most `width_px` wide. On request, saturated cells are red, and edges in
    focus are green."""
    from PIL import Image

    stride = max(1, -(-raw.shape[1] // 2 // width_px))
    height, width = (size // (2 * stride) * 2 * stride for size in raw.shape)
    cells = raw[:height, :width].reshape(height // (2 * stride), 2 * stride, width // (2 * stride), 2 * stride)
    few = np.ascontiguousarray(cells[:, :2, :, :2]).reshape(height // stride, width // stride)
    picture = develop(few, pattern=coding.pattern, black_dn=coding.black_dn, white_dn=coding.white_dn, gains=gains)
    if focus:
        picture[_any_of(_in_focus(_two_greens(raw[:height, :width], coding)[0]), stride)] = _SHARP
    if saturation:
        full = cells.max(axis=(1, 3)) >= coding.white_dn
        picture[full] = _SATURATED
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=85)
    return buffer.getvalue()


def _two_greens(raw: NDArray[np.uint16], coding: Coding) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return [h/2, w/2], both greens of each cell (for MONO the pixels of a diagonal) above black, as a share of
    the range."""
    planes = channels(raw, coding.pattern)
    first, second = (planes["G1"], planes["G2"]) if "G1" in planes else (raw[::2, ::2], raw[1::2, 1::2])
    span = np.float32(coding.white_dn - coding.black_dn)
    return (first.astype(np.float32) - coding.black_dn) / span, (
        second.astype(np.float32) - coding.black_dn
    ) / span


def _in_focus(green: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[h, w] True where the brightness changes steeply from one cell to the next."""
    here = np.zeros(green.shape, bool)
    for axis in (0, 1):
        near, far = np.moveaxis(green, axis, 0)[:-1], np.moveaxis(green, axis, 0)[1:]
        level = np.maximum(near, far)
        np.moveaxis(here, axis, 0)[:-1] |= (np.abs(far - near) > _SHARP_GRADIENT * level) & (level > _DARK)
    return here


def _any_of(mask: NDArray[np.bool_], stride: int) -> NDArray[np.bool_]:
    """Return blocks of `stride` x `stride`, True where any pixel is True."""
    height, width = (size // stride * stride for size in mask.shape)
    blocks = mask[:height, :width].reshape(height // stride, stride, width // stride, stride)
    return np.asarray(blocks.any(axis=(1, 3)))

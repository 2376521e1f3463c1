"""Colours of classes in maps and profiles, and pictures with a legend."""

from __future__ import annotations

import colorsys
import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

RGB = tuple[int, int, int]
NOT_LOOKED_AT: RGB = (255, 255, 255)
UNLIKE: RGB = (20, 20, 20)
UNKNOWN: RGB = (105, 105, 105)
AMBIGUOUS: RGB = (185, 185, 185)
_CLASSES: tuple[RGB, ...] = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (240, 228, 66), (204, 121, 167), (86, 180, 233), (230, 159, 0),
    (102, 51, 153), (128, 0, 0), (0, 90, 60),
)  # fmt: skip
"""The first seven can be distinguished by people with any kind of colour vision (Okabe and Ito, Color Universal
Design, 2008)."""
_GOLDEN = 0.618034
_ROW_PX, _PATCH_PX, _LETTER_PX = 26, 18, 8
_SMALLEST_PX, _LARGEST_PX = 480, 1600


def class_colour(number: int) -> RGB:
    """The colour of a class, from 0; no two of the first hundred are the same, and none is grey."""
    if number < len(_CLASSES):
        return _CLASSES[number]
    hue, turn = (number * _GOLDEN) % 1.0, number // 7
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.55 + 0.15 * (turn % 3), 0.65 + 0.15 * (turn % 2))
    return round(255 * red), round(255 * green), round(255 * blue)


def code_colours(count: int) -> list[RGB]:
    """Colours of `count` codes of a map: the four without a class, in grey, then the classes."""
    return [NOT_LOOKED_AT, UNLIKE, UNKNOWN, AMBIGUOUS, *(class_colour(number) for number in range(count - 4))]


def with_legend(pixels: NDArray[np.uint8], entries: Sequence[tuple[str, RGB]]) -> bytes:
    """Return a picture [h, w, 3] as PNG, with a legend below. Small pictures are enlarged by whole factors, very
    large ones are thinned out."""
    from PIL import Image, ImageDraw, ImageFont

    some_pixels = pixels[:: -(-pixels.shape[0] // _LARGEST_PX), :: -(-pixels.shape[1] // _LARGEST_PX)]
    factor = max(1, -(-_SMALLEST_PX // max(some_pixels.shape[:2])))
    shown_pixels = np.repeat(np.repeat(some_pixels, factor, axis=0), factor, axis=1)
    height, width = shown_pixels.shape[:2]
    needed_px = max((_PATCH_PX + 16 + _LETTER_PX * len(name) for name, _ in entries), default=0)
    width = max(width, needed_px)
    sheet = Image.new("RGB", (width, height + 10 + _ROW_PX * len(entries)), "white")
    sheet.paste(Image.fromarray(shown_pixels), (0, 0))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for row, (name, colour) in enumerate(entries):
        top = height + 8 + row * _ROW_PX
        draw.rectangle((2, top, 2 + _PATCH_PX, top + _PATCH_PX), fill=colour, outline=(90, 90, 90))
        draw.text((_PATCH_PX + 10, top), _printable(name), fill="black", font=font)
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG")
    return buffer.getvalue()


def _printable(name: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in name)


def css(colour: RGB) -> str:
    """The colour for a page."""
    return "#{:02x}{:02x}{:02x}".format(*colour)

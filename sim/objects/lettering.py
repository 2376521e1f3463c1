"""Roman capitals of one stroke width, for inscriptions that are cut with a fine tool."""

from __future__ import annotations

import numpy as np

from sim.objects.carving import Array, Place, distance_to_line

Strokes = tuple[tuple[Place, ...], ...]

LETTER_GAP, WORD_GAP = 0.24, 0.62
"""Gaps between letters and between words, in heights of a capital."""


def _arc(centre: Place, radii: Place, from_deg: float, to_deg: float) -> tuple[Place, ...]:
    angles = np.radians(np.linspace(from_deg, to_deg, 25))
    return tuple(
        (float(centre[0] + radii[0] * np.cos(a)), float(centre[1] + radii[1] * np.sin(a))) for a in angles
    )


_BOWL = ((0.0, 1.0), (0.24, 1.0), *_arc((0.24, 0.75), (0.26, 0.25), 90.0, -90.0), (0.0, 0.5))
_STEM = ((0.0, 0.0), (0.0, 1.0))
CAPITALS: dict[str, tuple[float, Strokes]] = {
    "A": (0.78, (((0.0, 0.0), (0.39, 1.0), (0.78, 0.0)), ((0.13, 0.34), (0.65, 0.34)))),
    "C": (0.80, (_arc((0.50, 0.5), (0.50, 0.5), 52.0, 308.0),)),
    "E": (0.50, (_STEM, ((0.0, 1.0), (0.50, 1.0)), ((0.0, 0.52), (0.43, 0.52)), ((0.0, 0.0), (0.50, 0.0)))),
    "I": (0.0, (_STEM,)),
    "L": (0.50, (((0.0, 1.0), (0.0, 0.0), (0.50, 0.0)),)),
    "M": (0.92, (((0.0, 0.0), (0.10, 1.0), (0.46, 0.06), (0.82, 1.0), (0.92, 0.0)),)),
    "N": (0.74, (((0.0, 0.0), (0.0, 1.0), (0.74, 0.0), (0.74, 1.0)),)),
    "O": (1.0, (_arc((0.5, 0.5), (0.5, 0.5), 0.0, 360.0),)),
    "P": (0.50, (_STEM, _BOWL)),
    "V": (0.78, (((0.0, 1.0), (0.39, 0.0), (0.78, 1.0)),)),
    "X": (0.70, (((0.0, 0.0), (0.70, 1.0)), ((0.0, 1.0), (0.70, 0.0)))),
    "·": (0.04, (((0.0, 0.5), (0.04, 0.5)),)),
}
"""Width of each capital and its strokes, in its height; V is U, as on Roman stones."""


def text_width(text: str) -> float:
    """Width of a line of capitals, in heights of a capital."""
    return sum(width for _, width in _advances(text)) - LETTER_GAP


def strokes_distance(text: str, x: Array, y: Array, height_mm: float) -> Array:
    """Distance [n] in mm of places [n] to the middle of the nearest stroke of a line of capitals.

    The line is `height_mm` high, stands on y = 0 and is centred on x = 0. Far from all letters it is infinite.
    """
    distance = np.full(x.shape, np.inf)
    start = -0.5 * text_width(text)
    for letter, advance in _advances(text):
        if letter != " ":
            width, strokes = CAPITALS[letter]
            u, v = x / height_mm - start, y / height_mm
            near = (u > -0.1) & (u < width + 0.1) & (v > -0.1) & (v < 1.1)
            for stroke in strokes:
                distance[near] = np.minimum(
                    distance[near], height_mm * distance_to_line(u[near], v[near], stroke)[0]
                )
        start += advance
    return distance


def _advances(text: str) -> list[tuple[str, float]]:
    """Letters, each with the way to the next one, in heights of a capital."""
    return [
        (letter, WORD_GAP - LETTER_GAP if letter == " " else CAPITALS[letter][0] + LETTER_GAP) for letter in text
    ]

"""Curves over the wavelength with their bands of uncertainty, patches of colour, bars of limits: drawings of a
page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.pages.page_parts import Drawing, Legend, Plot, Shape

Array = NDArray[np.float64]
_WIDE, _HIGH, _LEFT, _BELOW = 640, 260, 46, 24
COLOURS = ("var(--b)", "var(--r)", "var(--g)", "var(--soft)")


@dataclass(frozen=True, eq=False)
class Curve:
    """A line, with a band from `low` to `high` if they are given; all [n]."""

    name: str
    values: Array
    low: Array | None = None
    high: Array | None = None
    is_dashed: bool = False


def chart(title: str, nm: Array, curves: Sequence[Curve]) -> Plot:
    """Draw curves over the wavelengths [n]. The scale goes from 0 (or the lowest value, if it is below 0) to the
    highest value or band."""
    ends = [end for curve in curves for end in (curve.values, curve.low, curve.high) if end is not None]
    top = max(float(np.nanmax(end)) for end in ends) * 1.05 or 1.0
    bottom = min(0.0, *(float(np.nanmin(end)) for end in ends))

    def places(values: Array, at: Array) -> tuple[Array, Array]:
        x = _LEFT + (at - nm[0]) / (nm[-1] - nm[0]) * (_WIDE - _LEFT - 8)
        y = (_HIGH - _BELOW) - (values - bottom) / (top - bottom) * (_HIGH - _BELOW - 8)
        return x, y

    shapes = []
    for number, curve in enumerate(curves):
        colour = COLOURS[number % len(COLOURS)]
        if curve.low is not None and curve.high is not None:
            around = np.concatenate([curve.high, curve.low[::-1]]), np.concatenate([nm, nm[::-1]])
            style = f"fill:{colour};opacity:.22"
            shapes.append(Shape("polygon", {"points": points(*places(*around)), "style": style}))
        dash = ";stroke-dasharray:5 4" if curve.is_dashed else ""
        line = points(*places(curve.values, nm))
        shapes.append(Shape("polyline", {"points": line, "style": f"stroke:{colour}{dash}"}))
    shapes += [
        mark(_LEFT - 4, float(places(np.array(value), nm[0])[1]), f"{value:.3g}", "end") for value in (bottom, top)
    ]
    shapes += [
        mark(float(places(np.array(bottom), np.array(value))[0]), _HIGH - 6, f"{value:g} nm", "middle")
        for value in (nm[0], round(0.5 * (nm[0] + nm[-1])), nm[-1] - 12)
    ]
    names = {curve.name: COLOURS[number % len(COLOURS)] for number, curve in enumerate(curves)}
    return Plot(Drawing(title, _WIDE, _HIGH, shapes), Legend(names))


def patches(name: str, colours: Sequence[tuple[str, tuple[int, int, int]]]) -> Plot:
    """Draw patches side by side without a gap: (name, sRGB) of each."""
    shapes = [
        Shape("rect", {"x": 150 * at, "width": 150, "height": 70, "style": f"fill:rgb({red},{green},{blue})"})
        for at, (_, (red, green, blue)) in enumerate(colours)
    ]
    labels = ", ".join(label for label, _ in colours)
    return Plot(Drawing(f"{name}: {labels}", 150 * len(colours), 70, shapes, most_px=150 * len(colours)))


def bars(title: str, shares: Sequence[tuple[str, float]], limit_words: str) -> Plot:
    """Draw a bar for each (name, share of its limit); bars beyond 1 are red. The line is the limit, at half of the
    width. A longer bar is cut at twice the limit."""
    row, left_px, middle_px = 22, 300, 170
    shapes = []
    for number, (name, share) in enumerate(shares):
        y = row * number + 4
        shapes.append(mark(left_px - 8, y + 12, name if len(name) < 44 else f"{name[:42]}...", "end"))
        width = round(middle_px * min(max(share, 0.0), 2.0), 1)
        kind = "for" if share <= 1.0 else "against"
        shapes.append(
            Shape("rect", {"class": kind, "x": left_px, "y": y, "width": max(width, 1.0), "height": row - 8})
        )
    height = row * len(shares) + 24
    shapes.append(
        Shape("line", {"x1": left_px + middle_px, "x2": left_px + middle_px, "y1": 0, "y2": height - 20})
    )
    shapes.append(mark(left_px + middle_px, height - 6, limit_words, "middle"))
    return Plot(Drawing(title, left_px + 2 * middle_px + 8, height, shapes))


def points(x: Array, y: Array) -> str:
    """Return the corners of a line in SVG form."""
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def mark(x: float, y: float, words: str, anchor: str) -> Shape:
    """Return words in a drawing. `anchor` says which part of the words is at x: `start`, `middle_px` or `end`."""
    return Shape("text", {"x": round(x, 1), "y": round(y, 1), "text-anchor": anchor}, words)

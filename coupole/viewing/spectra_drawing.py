"""Curves over the wavelength with their bands of uncertainty, and patches of colour, as SVG for pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.viewing.page_parts import text

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


def chart(title: str, nm: Array, curves: Sequence[Curve]) -> str:
    """Curves over the wavelengths [n] from 0 (or what is below) to the highest value or band."""
    ends = [end for curve in curves for end in (curve.values, curve.low, curve.high) if end is not None]
    top = max(float(np.nanmax(end)) for end in ends) * 1.05 or 1.0
    bottom = min(0.0, *(float(np.nanmin(end)) for end in ends))

    def points(values: Array, at: Array) -> str:
        x = _LEFT + (at - nm[0]) / (nm[-1] - nm[0]) * (_WIDE - _LEFT - 8)
        y = (_HIGH - _BELOW) - (values - bottom) / (top - bottom) * (_HIGH - _BELOW - 8)
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))

    shapes = []
    for number, curve in enumerate(curves):
        colour = COLOURS[number % len(COLOURS)]
        if curve.low is not None and curve.high is not None:
            around = points(np.concatenate([curve.high, curve.low[::-1]]), np.concatenate([nm, nm[::-1]]))
            shapes.append(f'<polygon points="{around}" style="fill:{colour};opacity:.22"/>')
        dash = ";stroke-dasharray:5 4" if curve.is_dashed else ""
        shapes.append(f'<polyline points="{points(curve.values, nm)}" style="stroke:{colour}{dash}"/>')
    marks = [
        _mark(_LEFT - 4, points(np.array([v]), nm[:1]).split(",")[1], "end", f"{v:.3g}") for v in (bottom, top)
    ]
    marks += [_mark(points(np.array([bottom]), np.array([v])).split(",")[0], _HIGH - 6, "middle", f"{v:g} nm")
              for v in (nm[0], round(0.5 * (nm[0] + nm[-1])), nm[-1] - 12)]  # fmt: skip
    legend = "".join(
        f'<li><span class="swatch" style="background:{COLOURS[number % len(COLOURS)]}"></span>'
        f"{text(curve.name)}</li>"
        for number, curve in enumerate(curves)
    )
    return (
        f'<figure><svg viewBox="0 0 {_WIDE} {_HIGH}" role="img" aria-label="{text(title)}">{"".join(shapes)}'
        f'{"".join(marks)}</svg><figcaption>{text(title)}</figcaption><ul class="legend">{legend}</ul></figure>'
    )


def patches(pairs: Sequence[tuple[str, Sequence[tuple[str, tuple[int, int, int]]]]]) -> str:
    """Rows of patches side by side without a gap: a name, then (name, sRGB) of each."""
    rows = []
    for name, colours in pairs:
        cells = "".join(
            f'<rect x="{150 * at}" width="150" height="70" style="fill:rgb({red},{green},{blue})"/>'
            for at, (_, (red, green, blue)) in enumerate(colours)
        )
        labels = ", ".join(label for label, _ in colours)
        rows.append(
            f'<figure><svg viewBox="0 0 {150 * len(colours)} 70" style="max-width:{150 * len(colours)}px" '
            f'role="img" aria-label="{text(f"{name}: {labels}")}">{cells}</svg>'
            f"<figcaption>{text(name)}: {text(labels)}</figcaption></figure>"
        )
    return "".join(rows)


def _mark(x: object, y: object, anchor: str, words: str) -> str:
    style = "font-size:12px;fill:var(--soft)"
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" style="{style}">{text(words)}</text>'

"""A drawing for makie: a plum tree in blossom before a full moon, over waves, on a tall panel."""

from __future__ import annotations

import numpy as np

from coupole.appearance.matter import makie_drawing
from sim.objects.carving import Array, Place, curve, distance_to_line

_EDGE_MM = 0.12
"""Width beside a line over which the powder gets thinner."""
_BRANCHES: tuple[tuple[tuple[Place, ...], float], ...] = (
    (((-7.5, -31.0), (-4.0, -22.0), (-5.5, -12.0), (-0.5, -3.0), (-2.5, 7.0), (2.5, 17.0), (1.0, 27.0)), 1.25),
    (((-5.2, -14.0), (0.5, -10.5), (4.5, -12.5), (7.4, -8.0)), 0.55),
    (((-1.0, -3.0), (3.5, 0.5), (4.5, 5.5), (7.0, 9.0)), 0.5),
    (((-2.4, 6.0), (-5.5, 10.0), (-5.0, 15.0), (-7.4, 20.0)), 0.5),
    (((-4.6, -20.0), (-7.0, -14.0), (-7.2, -8.0)), 0.4),
    (((1.8, 14.0), (4.6, 16.5), (6.8, 15.5)), 0.32),
    (((2.4, 19.0), (-0.8, 22.5), (-3.4, 27.5)), 0.35),
)
"""Points of each branch, and half its width at the foot, mm; it ends in a third of that."""
_BLOSSOMS: tuple[tuple[float, float, float, float], ...] = (
    (4.4, -11.8, 2.3, 0.3), (7.0, -7.4, 1.5, 1.1), (4.2, 4.4, 2.2, 0.8), (6.6, 9.3, 1.4, 0.1),
    (-5.2, 12.3, 2.3, 0.5), (-7.0, 20.2, 1.3, 0.9), (-7.0, -8.0, 1.7, 0.2), (6.4, 15.6, 1.5, 0.7),
    (0.9, 26.6, 2.0, 0.4), (-3.4, 27.6, 1.4, 0.0), (-1.6, 1.8, 1.9, 0.6), (0.3, -17.5, 1.3, 0.2),
    (3.4, -19.0, 0.9, 0.8),
)  # fmt: skip
"""Middle, radius, mm, and turn, rad."""
_MOON: tuple[float, float, float] = (3.0, 20.5, 5.2)
_WAVES_BELOW_MM, _WAVES_PERIOD_MM = -20.5, 5.6


def powder_share(x: Array, y: Array) -> Array:
    """Share [n] of the surface that gold powder covers at places [n] of a panel of 17 x 62 mm about the origin."""
    mist = 0.55 * np.exp(-(((y + 6.0 + 0.25 * x) / 5.0) ** 2)) * (0.5 + 0.5 * np.sin(0.35 * x + 1.0)) ** 2
    share = np.maximum(0.25 * mist, _moon(x, y))
    share = np.maximum(share, _waves(x, y))
    for points, half_width in _BRANCHES:
        distance, along = distance_to_line(x, y, curve(points))
        outline_mm = half_width * (1.0 - 0.67 * along)
        share = np.where(distance < outline_mm + 0.35, np.minimum(share, 0.05), share)
        bark = 0.72 + 0.28 * np.sin(9.0 * y + 5.0 * x)
        share = np.maximum(share, bark * _line(distance - outline_mm))
    for blossom in _BLOSSOMS:
        share = _with_blossom(share, x, y, blossom)
    return np.asarray(np.clip(share, 0.0, 0.97))


def raised_mm(x: Array, y: Array) -> Array:
    """Height [n] by which blossoms and boughs rise over the lacquer (takamakie)."""
    height = np.zeros(x.shape)
    for points, half_width in _BRANCHES:
        distance, along = distance_to_line(x, y, curve(points))
        outline_mm = half_width * (1.0 - 0.67 * along)
        height = np.maximum(height, 0.25 * np.sqrt(np.maximum(0.0, 1.0 - (distance / outline_mm) ** 2)))
    for centre_x, centre_y, radius, _ in _BLOSSOMS:
        across = np.hypot(x - centre_x, y - centre_y) / radius
        height = np.maximum(height, 0.22 * np.maximum(0.0, 1.0 - across**2) + 0.10 * (across < 0.18))
    return height


def _line(outside_mm: Array) -> Array:
    """1 inside of a line, falling to 0 over its edge."""
    return np.clip(0.5 - outside_mm / _EDGE_MM, 0.0, 1.0)


def _moon(x: Array, y: Array) -> Array:
    centre_x, centre_y, radius = _MOON
    away = np.hypot(x - centre_x, y - centre_y)
    haze = 0.5 * np.exp(-np.maximum(0.0, away - radius) / 1.6)
    return np.where(away < radius, 0.80 - 0.35 * np.clip((centre_y - y) / radius, 0.0, 1.0), 0.25 * haze)


def _waves(x: Array, y: Array) -> Array:
    drawing = makie_drawing.motif("waves", _WAVES_PERIOD_MM, _EDGE_MM)
    near = y < _WAVES_BELOW_MM
    share = np.zeros(x.shape)
    share[near] = drawing(np.stack([x[near], y[near]], axis=-1))
    return share * np.clip((_WAVES_BELOW_MM - y) / 3.0, 0.0, 1.0)


def _with_blossom(share: Array, x: Array, y: Array, blossom: tuple[float, float, float, float]) -> Array:
    """Draw five petals in outline, filled towards their tips, with stamens; what is behind them is covered."""
    centre_x, centre_y, radius, turn = blossom
    r, phi = np.hypot(x - centre_x, y - centre_y), np.arctan2(y - centre_y, x - centre_x) - turn
    step = 2.0 * np.pi / 5.0
    beside = np.mod(phi + 0.5 * step, step) - 0.5 * step
    petal_mm = radius * (0.55 + 0.45 * np.abs(np.cos(2.5 * beside)) ** 0.6)
    inside = r < petal_mm + 0.2
    outline = _line(np.abs(r - petal_mm) - 0.11)
    fill = np.where(r < petal_mm, 0.75 * np.clip(r / radius - 0.35, 0.0, 1.0), 0.0)
    ray = np.abs(r * np.sin(np.mod(phi + 0.1 * step, step / 3.0) - step / 6.0))
    stamens = _line(ray - 0.06) * (r < 0.45 * radius) + _line(r - 0.10 * radius)
    petals = np.maximum(np.maximum(outline, fill), np.minimum(stamens, 1.0))
    return np.where(inside, petals, share)

"""The head of the plaque: a youth with locks of curls, as an implicit solid.

The unit is half the head's height, chin to crown; x to the viewer's right, y up, z towards the viewer.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sim.objects.implicit_solid import Array, Form, ball, height_above_plane, mirror_pair

TURN_DEG = (-5.0, 16.0, 3.0)
"""Pitch (down), yaw (towards +x) and roll of the head."""
DEEPEST = -0.9
"""Plane behind which no part of the head is seen."""
_HIGHEST = 1.35
_SKULL, _SKULL_RADII = (0.0, 0.22, -0.15), (0.74, 0.84, 0.86)
_EYE, _EYE_RADIUS, _EYE_HALF_WIDTH = (0.268, -0.020, 0.490), 0.165, 0.142
_LID_POINTS = 9
_ROWS_OF_CURLS = ((11, 0.62, 0.62, 0.150), (13, 0.78, 0.80, 0.165), (13, 0.90, 0.97, 0.165))
"""Number of curls of a row, its half width and height over the eyes, and the radius of a curl."""
_LOCKS = (
    (0.72, -0.24, -0.02),
    (0.70, -0.50, -0.10),
    (0.66, -0.76, -0.18),
    (0.61, -1.00, -0.26),
    (0.56, -1.22, -0.34),
)


def head_height(x: Array, y: Array) -> Array:
    """Return the height [...] of the turned head above places [...] of its plane, in the head's unit; `DEEPEST`
    where there is no head."""
    turn = Rotation.from_euler("xyz", [-TURN_DEG[0], TURN_DEG[1], -TURN_DEG[2]], degrees=True).as_matrix()
    return height_above_plane([*_face(), *_eyes(), *_mouth(), *_hair()], x, y, turn, _HIGHEST, DEEPEST)


def _face() -> list[Form]:
    forms = [
        ball(_SKULL, 1.0, stretch=_SKULL_RADII),
        ball((0.0, -0.30, 0.10), 1.0, 0.16, stretch=(0.56, 0.72, 0.62)),
        Form((0.0, -0.80, -0.25), (0.0, -1.9, -0.45), (0.36, 0.42), 0.12),
        ball((0.0, -0.885, 0.475), 0.15, 0.16, stretch=(1.15, 0.9, 1.0)),
        ball((0.0, 0.34, 0.46), 0.30, 0.25, stretch=(1.6, 1.0, 0.7)),
    ]
    for form in (
        ball((0.30, -0.28, 0.44), 0.24, 0.20),
        Form((0.34, -0.62, 0.22), (0.16, -0.86, 0.42), (0.16, 0.12), 0.20),
        Form((0.10, 0.115, 0.640), (0.27, 0.165, 0.610), (0.050, 0.060), 0.10),
        Form((0.27, 0.165, 0.610), (0.46, 0.06, 0.440), (0.060, 0.050), 0.10),
        ball((0.270, -0.035, 0.80), 0.16, 0.14, is_cut=True, stretch=(1.25, 0.75, 1.0)),
    ):
        forms += mirror_pair(form)
    forms += [
        Form((0.0, 0.12, 0.650), (0.0, -0.22, 0.840), (0.056, 0.070), 0.09),
        ball((0.0, -0.255, 0.845), 0.085, 0.06),
        *mirror_pair(ball((0.090, -0.275, 0.735), 0.066, 0.05, stretch=(1.0, 0.85, 1.15))),
        *mirror_pair(ball((0.050, -0.335, 0.79), 0.028, 0.03, is_cut=True)),
    ]
    return forms


def _eyes() -> list[Form]:
    """Return eyeballs, both lids, and drilled pupils."""
    forms = [ball(_EYE, _EYE_RADIUS, 0.01)]
    for rise, thickness in ((0.088, 0.025), (-0.062, 0.017)):
        forms += _lid(rise, thickness)
    forms.append(ball((_EYE[0] + 0.005, _EYE[1], _EYE[2] + _EYE_RADIUS + 0.008), 0.028, 0.006, is_cut=True))
    return [part for form in forms for part in mirror_pair(form)]


def _lid(rise: float, thickness: float) -> list[Form]:
    """An arc over the eyeball from corner to corner, `rise` above the line between them."""
    share = np.linspace(-1.0, 1.0, _LID_POINTS)
    x, y = _EYE_HALF_WIDTH * share, rise * (1.0 - share**2) - 0.012 - 0.012 * share
    z = np.sqrt((_EYE_RADIUS + 0.004) ** 2 - np.minimum(0.8 * _EYE_RADIUS**2, x**2 + y**2))
    points = [(_EYE[0] + a, _EYE[1] + b, _EYE[2] + c) for a, b, c in zip(x, y, z, strict=True)]
    radii = thickness * (1.0 - 0.5 * np.abs(share))
    return [Form(points[i], points[i + 1], (radii[i], radii[i + 1])) for i in range(_LID_POINTS - 1)]


def _mouth() -> list[Form]:
    return [
        ball((0.0, -0.55, 0.475), 0.25, 0.18, stretch=(1.25, 0.9, 0.9)),
        Form((0.0, -0.39, 0.778), (0.0, -0.455, 0.755), (0.012, 0.018), 0.05, is_cut=True),
        *mirror_pair(Form((0.035, -0.515, 0.712), (0.130, -0.535, 0.688), (0.050, 0.040), 0.025)),
        *mirror_pair(Form((0.130, -0.535, 0.688), (0.225, -0.562, 0.630), (0.040, 0.016), 0.025)),
        *mirror_pair(Form((0.025, -0.632, 0.690), (0.120, -0.612, 0.672), (0.060, 0.048), 0.025)),
        *mirror_pair(Form((0.120, -0.612, 0.672), (0.225, -0.568, 0.630), (0.048, 0.014), 0.025)),
        *mirror_pair(Form((0.0, -0.573, 0.772), (0.12, -0.566, 0.735), (0.012, 0.012), 0.014, is_cut=True)),
        *mirror_pair(Form((0.12, -0.566, 0.735), (0.240, -0.558, 0.650), (0.012, 0.012), 0.014, is_cut=True)),
        Form((-0.06, -0.735, 0.715), (0.06, -0.735, 0.715), (0.022, 0.022), 0.08, is_cut=True),
    ]


def _hair() -> list[Form]:
    """Return a cap, rows of snail curls over the brow, and locks beside the neck."""
    forms = [ball((0.0, 0.30, -0.30), 1.0, 0.02, stretch=(0.86, 0.84, 0.80))]
    for count, across, up, radius in _ROWS_OF_CURLS:
        for number in range(count):
            angle = np.pi * (number / (count - 1) * 1.14 - 0.07)
            x, y = across * np.cos(angle), 0.08 + up * np.sin(angle)
            forms.append(_curl(x, y, _on_skull(x, y), radius))
    sides = (-1.0, 1.0)
    forms += [_curl(s * x, y, z, 0.185 - 0.01 * n) for n, (x, y, z) in enumerate(_LOCKS) for s in sides]
    return forms


def _curl(x: float, y: float, z: float, radius: float) -> Form:
    """Return a ball with a spiral groove; the direction of the groove depends on the ball's side."""
    return ball((x, y, z), radius, 0.02, groove=(0.32 * radius, 2.2, 1.0 if x > 0.0 else -1.0))


def _on_skull(x: float, y: float) -> float:
    """Height z of the skull's front at a place; outside the skull, the height of its rim."""
    across = ((x - _SKULL[0]) / _SKULL_RADII[0]) ** 2 + ((y - _SKULL[1]) / _SKULL_RADII[1]) ** 2
    return float(_SKULL[2] + _SKULL_RADII[2] * np.sqrt(max(0.0, 1.0 - across)))

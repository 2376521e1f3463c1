"""Sculpture from implicit solids: round cones and ellipsoids, joined and cut smoothly, as a height above a plane.

A solid is a list of forms in order. Each form is added to the solid of the earlier forms, or cut from it. The
transition is smooth and has a given width (the polynomial smooth minimum of Quilez, after Blinn, A generalization
of algebraic surface drawing, 1982). Lengths are in any unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

Array = NDArray[np.float64]
Point = tuple[float, float, float]

_STEPS, _CAUTION = 200, 0.7
"""Greatest number of steps of a ray, and the share of the distance that a step takes, because blended distances
are only bounds."""
_NEAR = 5e-5
"""Distance to the surface at which a ray has met it."""


@dataclass(frozen=True)
class Form:
    """A round cone from `start` to `end`; a ball if they are equal, an ellipsoid if `stretch` is not 1."""

    start: Point
    end: Point
    radii: tuple[float, float]
    """Radii at both ends, before the axes are stretched by `stretch`."""
    blend: float = 0.0
    """Width of the transition to the forms before it; 0 for a sharp edge."""
    is_cut: bool = False
    """True if the form is cut away."""
    stretch: Point = (1.0, 1.0, 1.0)
    """Factors of the form's lengths along the axes, about `start`."""
    groove: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Depth, number of turns, and hand (1 or -1) of a spiral cut into a ball about the z axis."""

    def row(self) -> list[float]:
        """The form as a row of the table that compiled code reads."""
        flags = [self.blend, -1.0 if self.is_cut else 1.0]
        return [*self.start, *self.end, *self.radii, *flags, *self.stretch, *self.groove]


def ball(centre: Point, radius: float, blend: float = 0.0, **more: object) -> Form:
    """A ball, or with `stretch` an ellipsoid."""
    return Form(centre, centre, (radius, radius), blend, **more)  # type: ignore[arg-type]


def mirror_pair(form: Form) -> list[Form]:
    """The form and its mirror image at x = 0."""
    (ax, ay, az), (bx, by, bz), (depth, turns, hand) = form.start, form.end, form.groove
    image = Form(
        (-ax, ay, az), (-bx, by, bz), form.radii, form.blend, form.is_cut, form.stretch, (depth, turns, -hand)
    )
    return [form, image]


def height_above_plane(solid: Sequence[Form], x: Array, y: Array, turn: Array, top: float, bottom: float) -> Array:
    """Height [...] of the solid's highest point above places `x`, `y` [...]; `bottom` where there is none.

    `turn` [3, 3] is the rotation from the solid's axes to the plane's axes, z away from the plane. Rays start at
    `top`.
    """
    table = np.array([form.row() for form in solid])
    places = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    heights = np.empty(len(places))
    _trace(table, places, np.ascontiguousarray(turn.T), top, bottom, heights)
    return heights.reshape(x.shape)


@kernel(parallel=True)
def _trace(table, places, plane_to_solid, top, bottom, heights):  # type: ignore[no-untyped-def]
    for i in numba.prange(len(places)):
        along, foot = np.empty(3), np.empty(3)
        for k in range(3):
            along[k] = plane_to_solid[k, 2]
            foot[k] = plane_to_solid[k, 0] * places[i, 0] + plane_to_solid[k, 1] * places[i, 1]
        near_rows = np.empty(len(table), np.int64)
        count = _forms_near_ray(table, foot, along, near_rows)
        z = top
        for _ in range(_STEPS):
            x, y, depth = foot[0] + z * along[0], foot[1] + z * along[1], foot[2] + z * along[2]
            distance = _distance(table, near_rows[:count], x, y, depth)
            if distance < _NEAR:
                break
            z -= max(_CAUTION * distance, 2.0 * _NEAR)
            if z < bottom:
                z = bottom
                break
        heights[i] = z


@kernel
def _forms_near_ray(table, foot, along, near_rows):  # type: ignore[no-untyped-def]
    """Write the rows of those forms that can shape the solid on the ray; return their number."""
    count = 0
    for row in range(len(table)):
        form = table[row]
        on_ray = 0.0
        for k in range(3):
            on_ray += (0.5 * (form[k] + form[k + 3]) - foot[k]) * along[k]
        away, half_length = 0.0, 0.0
        for k in range(3):
            away += (0.5 * (form[k] + form[k + 3]) - foot[k] - on_ray * along[k]) ** 2
            half_length += 0.25 * (form[k + 3] - form[k]) ** 2
        longest = max(form[10], form[11], form[12])
        reach = max(form[6], form[7]) * longest + 1.25 * form[8] * longest / min(form[10], form[11], form[12])
        if np.sqrt(away) < np.sqrt(half_length) + reach:
            near_rows[count] = row
            count += 1
    return count


@kernel
def _distance(table, rows, x, y, z):  # type: ignore[no-untyped-def]
    """Bound of the signed distance to the solid of these rows of the table; negative inside."""
    total = 1e9
    for row in rows:
        form = table[row]
        distance = _distance_to_form(form, x, y, z)
        if form[9] < 0.0:
            total = -_smooth_minimum(distance, -total, form[8])
        else:
            total = _smooth_minimum(total, distance, form[8])
    return total


@kernel
def _smooth_minimum(a, b, blend):  # type: ignore[no-untyped-def]
    if blend <= 0.0:
        return min(a, b)
    overlap = max(blend - abs(a - b), 0.0) / blend
    return min(a, b) - 0.25 * overlap * overlap * blend


@kernel
def _distance_to_form(form, x, y, z):  # type: ignore[no-untyped-def]
    sx, sy, sz = form[10], form[11], form[12]
    px, py, pz = (x - form[0]) / sx, (y - form[1]) / sy, (z - form[2]) / sz
    bx, by, bz = (form[3] - form[0]) / sx, (form[4] - form[1]) / sy, (form[5] - form[2]) / sz
    length_squared = bx * bx + by * by + bz * bz
    share = 0.0
    if length_squared > 0.0:
        share = min(1.0, max(0.0, (px * bx + py * by + pz * bz) / length_squared))
    dx, dy, dz = px - share * bx, py - share * by, pz - share * bz
    distance = np.sqrt(dx * dx + dy * dy + dz * dz) - (form[6] + share * (form[7] - form[6]))
    if form[13] > 0.0 and distance < 2.0 * form[13]:
        across = np.sqrt(px * px + py * py) / form[6]
        phase = 2.0 * np.pi * form[14] * across + form[15] * np.arctan2(py, px)
        distance += 0.5 * form[13] * (1.0 + np.cos(phase)) * min(1.0, 4.0 * across)
    return distance * min(sx, sy, sz)

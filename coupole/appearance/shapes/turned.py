"""Bodies for lacquer: turned on a lathe, and boxes with rounded edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coupole.appearance.shapes.triangles import Array, grid_faces
from coupole.errors import InputError

_EDGE_STEPS = 6
BOWL_MM = (
    (0.0, 8.0), (12.0, 8.6), (24.0, 13.0), (33.0, 22.0), (37.0, 35.0), (38.2, 42.0), (39.3, 43.2),
    (40.3, 42.0), (39.3, 34.0), (35.5, 20.0), (27.0, 10.0),
    (18.5, 6.0), (17.5, 1.0), (16.5, 0.0), (8.0, 0.0), (0.0, 0.0),
)  # fmt: skip
"""A bowl on a foot: radius and height from the middle of its inside over the rim to the middle of its foot."""


def turned_body(profile_mm: Sequence[tuple[float, float]], *, around: int = 256, step_mm: float = 0.5) -> Array:
    """Corners [n, 3, 3] of a closed body turned about z.

    `profile_mm` has radius and height of points of its outline, from the axis to the axis, with the body on the
    right: for a bowl, from the middle of its inside over the rim to the middle of its foot. Between the points the
    outline is Akima's curve (JACM 17(4), 1970), by the length of the chords. Raises InputError.
    """
    from scipy.interpolate import Akima1DInterpolator

    outline = np.asarray(profile_mm, dtype=float)
    chords = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    if np.any(outline[[0, -1], 0] != 0.0) or np.any(outline[1:-1, 0] <= 0.0) or np.any(chords == 0.0):
        raise InputError(
            "profile: expected points from the axis (radius 0) to the axis, all other points off the axis, and "
            "no point twice; found radii {outline[:, 0].tolist()}"
        )
    way = np.concatenate([[0.0], np.cumsum(chords)])
    steps = max(2 * len(outline), int(way[-1] / step_mm))
    line = np.asarray(Akima1DInterpolator(way, outline)(np.linspace(0.0, way[-1], steps + 1)))
    if np.any(line[1:-1, 0] <= 0.0):
        raise InputError(
            "profile: the curve through its points crosses the axis between two of them; add points there"
        )
    line[[0, -1], 0] = 0.0
    r, z = line.T
    if np.sum((r[1:] + r[:-1]) * (r[1:] * z[:-1] - r[:-1] * z[1:])) <= 0.0:
        raise InputError("profile: the body is on the left of its points; give them in the opposite order")
    angle = np.arange(around + 1) * 2.0 * np.pi / around
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turn[-1] = turn[0]
    points = np.concatenate([turn[:, None] * r[:, None], np.broadcast_to(z[:, None], (around + 1, len(z), 1))], 2)
    corners = points.reshape(-1, 3)[grid_faces(around, len(z) - 1)]
    flat = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) == 0.0
    return np.asarray(corners[~flat])


def rounded_box(size_mm: tuple[float, float, float], edge_mm: float, *, step_mm: float = 4.0) -> Array:
    """Return corners [n, 3, 3] of a closed box around the z axis that rests on z = 0, with edges rounded by
    `edge_mm`."""
    half = 0.5 * np.asarray(size_mm, dtype=float)
    if edge_mm <= 0.0 or edge_mm >= half.min():
        raise InputError(
            f"box: expected edges rounded by more than 0 and less than half its least side, {half.min():g} mm; "
            f"found {edge_mm:g} mm"
        )
    lines = [_lines(h, edge_mm, step_mm) for h in half]
    sides = []
    for axis in range(3):
        u, v = lines[(axis + 1) % 3], lines[(axis + 2) % 3]
        faces = grid_faces(len(v) - 1, len(u) - 1)
        across, up = np.meshgrid(u, v)
        for sign in (1.0, -1.0):
            cube = np.empty((across.size, 3))
            cube[:, axis] = sign * half[axis]
            cube[:, (axis + 1) % 3], cube[:, (axis + 2) % 3] = across.ravel(), up.ravel()
            core = np.clip(cube, -(half - edge_mm), half - edge_mm)
            away = (cube - core) / np.linalg.norm(cube - core, axis=1, keepdims=True)
            corners = (core + edge_mm * away)[faces]
            sides.append(corners if sign > 0 else corners[:, ::-1])
    return np.asarray(np.concatenate(sides) + np.array([0.0, 0.0, half[2]]))


def _lines(half_mm: float, edge_mm: float, step_mm: float) -> Array:
    """Return places of grid lines over a side, dense where it is round."""
    flat_mm = half_mm - edge_mm
    arc = flat_mm + edge_mm * np.tan(np.linspace(0.0, 0.25 * np.pi, _EDGE_STEPS + 1))
    middle = np.linspace(-flat_mm, flat_mm, max(2, int(2.0 * flat_mm / step_mm)) + 1)
    return np.concatenate([-arc[:0:-1], middle, arc[1:]])

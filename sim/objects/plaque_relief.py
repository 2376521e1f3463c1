"""The carved surface of the plaque: heights over its back, and the parts to which places in mm belong.

Frame: z up, back at z = 0, origin below the middle; x and y as in `PLAQUE_MM`. A frame of eggs and darts encloses
three bays over a band with an inscription: a panel of lacquer, a roundel with a head, and a strip of cloth.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from sim.objects import plum_branch
from sim.objects.carved_head import DEEPEST, head_height
from sim.objects.carving import Array, Mask, half_round, noise, smooth_step
from sim.objects.lettering import strokes_distance

PLAQUE_MM = (112.0, 84.0)
FIELD_MM = 8.0
"""Height of the sunk field between the mouldings."""
ROUNDEL = (0.0, 5.0, 26.5)
"""Middle and radius of the roundel's field, mm."""
ROPE_MM = 2.0
"""Half the width of the rope around the roundel."""
HEAD = (0.5, 8.5, 14.5)
"""Middle of the head, and its unit (`sim.objects.carved_head`), mm."""
HEAD_DEPTH, HEAD_SINKS = 0.82, -0.30
"""Factor by which the head is flattened, as in a relief, and the part of the head's depth that lies inside the
field.
"""
NIMBUS = (0.5, 11.0, 21.0)
"""Middle and radius, mm."""
LACQUER_MM, CLOTH_MM = (-49.2, -33.2, -25.2, 35.2), (35.0, 47.6, -23.0, 36.0)
"""Left, right, bottom and top of the panel and of the strip."""
BAND_MM = (-49.5, 49.5, -36.0, -27.6)
INSCRIPTION, LETTER_MM, BASELINE_MM = "LA COVPOLE · MLXXX LVMINA", 4.6, -34.1
STROKE_MM, STROKE_DEPTH_MM = 0.3, 0.06
"""Width and depth of the cut strokes."""
THREAD_MM = 0.7
_FRAME_MM, _EGG_MM = 6.0, 4.0
_BAR_X_MM, _BAR_Y_MM, _BAR_HALF_MM = 31.6, -26.5, 0.9
_HEAD_STEP_MM = 0.15


def height_mm(x: Array, y: Array) -> Array:
    """Height [...] of the true surface at places [...] of the plaque."""
    flat_x, flat_y = np.ravel(x).astype(float), np.ravel(y).astype(float)
    height = np.empty(flat_x.shape)
    in_frame = edge_distance(flat_x, flat_y) < _FRAME_MM
    in_band = ~in_frame & (flat_y < _BAR_Y_MM - _BAR_HALF_MM)
    middle = np.hypot(flat_x - ROUNDEL[0], flat_y - ROUNDEL[1]) < ROUNDEL[2] + 2.0 * ROPE_MM
    lacquer, cloth = in_lacquer(flat_x, flat_y), in_cloth(flat_x, flat_y)
    parts = [(in_frame, _frame), (in_band, _band), (middle & ~in_frame & ~in_band, _medallion)]
    parts += [(lacquer, _lacquer), (cloth & ~in_frame, cloth_mm)]
    is_left = np.ones(flat_x.shape, bool)
    for where, _ in parts:
        is_left &= ~where
    for where, part in [*parts, (is_left, _ground)]:
        height[where] = part(flat_x[where], flat_y[where])
    return np.asarray(height.reshape(np.shape(x)))


def edge_distance(x: Array, y: Array) -> Array:
    """Distance [n] to the nearest edge of the plaque."""
    return np.minimum(0.5 * PLAQUE_MM[0] - np.abs(x), 0.5 * PLAQUE_MM[1] - np.abs(y))


def in_roundel(x: Array, y: Array) -> Mask:
    return np.hypot(x - ROUNDEL[0], y - ROUNDEL[1]) < ROUNDEL[2]


def in_lacquer(x: Array, y: Array) -> Mask:
    return _inside(x, y, LACQUER_MM) > 0.0


def in_cloth(x: Array, y: Array) -> Mask:
    """True where the strip is; below its hem only the warp's threads hang."""
    west, east, south, north = CLOTH_MM
    fringe = (np.floor(x / (1.5 * THREAD_MM)) % 2 == 0) & (y > south - 3.0 + 0.8 * np.sin(7.0 * x))
    inside = (x > west) & (x < east) & (y < north) & ((y > south) | fringe)
    return np.asarray(inside)


def head_mm(x: Array, y: Array) -> Array:
    """Height [n] of the head over the plaque's back; far below the field beside it."""
    grid, first_x, first_y = _head_grid()
    from scipy.ndimage import map_coordinates

    places = [(y - first_y) / _HEAD_STEP_MM, (x - first_x) / _HEAD_STEP_MM]
    depth = map_coordinates(grid, places, order=1, cval=DEEPEST)
    return np.asarray(FIELD_MM - 1.0 + HEAD_DEPTH * HEAD[2] * (depth - HEAD_SINKS))


def cloak_mm(x: Array, y: Array) -> Array:
    """Height [n] of the cloak over the plaque's back: folds that fall from the neck; 0 beside it."""
    across, below = x - HEAD[0], y - (HEAD[1] - 0.95 * HEAD[2])
    fan = np.arctan2(across, 9.0 - below)
    folds = 0.75 * np.abs(np.sin(9.0 * fan + 0.5)) ** 0.7 + 0.25 * np.sin(23.0 * fan)
    shoulder = 4.8 - 0.009 * across**2
    inside = _below_neckline(x, y)
    body = FIELD_MM + shoulder * smooth_step(inside / 1.2) + folds + 0.5 * on_hem(x, y)
    return np.where((inside > 0.0) & (below < 2.6 - 0.020 * across**2), body, 0.0)


def on_hem(x: Array, y: Array) -> Mask:
    """True on the cloak's border at the neck."""
    inside = _below_neckline(x, y)
    return (inside > 0.3) & (inside < 2.0)


def _below_neckline(x: Array, y: Array) -> Array:
    across, below = x - HEAD[0], y - (HEAD[1] - 0.95 * HEAD[2])
    return 0.060 * across**2 - 4.0 - below


def cloth_mm(x: Array, y: Array) -> Array:
    """Height [n] of the strip of cloth: folds, and each thread over and under the others (plain weave)."""
    west, east, south, _ = CLOTH_MM
    across = (x - 0.5 * (west + east)) / (east - west)
    folds = 1.1 * np.sin(0.27 * y + 2.2 * across) + 0.7 * np.cos(7.5 * across + 0.06 * y)
    u, v = x / THREAD_MM, y / THREAD_MM
    warp_up = (np.floor(u) + np.floor(v)) % 2 == 0
    in_u, in_v = 2.0 * (u % 1.0) - 1.0, 2.0 * (v % 1.0) - 1.0
    across_thread, along_thread = np.where(warp_up, in_u, in_v), np.where(warp_up, in_v, in_u)
    thread = 0.30 * np.sqrt(np.maximum(0.0, 1.0 - across_thread**2)) * (1.0 - 0.45 * along_thread**2)
    hanging = 0.30 * np.sqrt(np.maximum(0.0, 1.0 - in_u**2))
    return FIELD_MM + 2.2 + folds + np.where(y > south, thread, hanging)


def cut_distance(x: Array, y: Array) -> Array:
    """Distance [n] to the middle of the nearest stroke of the inscription; infinite far from it."""
    return strokes_distance(INSCRIPTION, x, y - BASELINE_MM, LETTER_MM)


def bead_mm(x: Array, y: Array) -> tuple[Array, Mask]:
    """Height [n] over the frame's foot of the beads and reels inside of it, and True where they are."""
    inset = edge_distance(x, y) - 5.0
    along = _along_edge(x, y) % 2.0 - 1.0
    bead = 0.85 * np.sqrt(np.maximum(0.0, 1.0 - (along / 0.62) ** 2 - (inset / 0.8) ** 2))
    reel = 0.5 * half_round(inset / 0.6) * (np.abs(np.abs(along) - 0.82) < 0.10)
    return np.maximum(bead, reel), np.abs(inset) < 0.85


@cache
def _head_grid() -> tuple[Array, float, float]:
    """Heights of the head in its unit on a grid, and x and y of the first node."""
    reach_x, low, high = 1.25 * HEAD[2], -1.75 * HEAD[2], 1.45 * HEAD[2]
    xs, ys = np.arange(-reach_x, reach_x, _HEAD_STEP_MM), np.arange(low, high, _HEAD_STEP_MM)
    x, y = np.meshgrid(xs / HEAD[2], ys / HEAD[2])
    return head_height(x, y), float(HEAD[0] + xs[0]), float(HEAD[1] + ys[0])


def _ground(x: Array, y: Array) -> Array:
    """The sunk field, with bars between the bays and flowers in the corners of the middle one."""
    field = FIELD_MM + 0.02 * noise(x, y, 0.5, 1) + 0.05 * noise(x, y, 2.5, 2)
    return np.maximum(field, np.maximum(_bars(x, y), _flowers(x, y)))


def _medallion(x: Array, y: Array) -> Array:
    """The roundel and its rope."""
    inside = in_roundel(x, y)
    height = np.empty(x.shape)
    height[inside] = _roundel(x[inside], y[inside])
    height[~inside] = _ground(x[~inside], y[~inside])
    return np.maximum(height, _rope(x, y))


def _roundel(x: Array, y: Array) -> Array:
    """Field with nimbus, cloak and head."""
    from_middle = np.hypot(x - NIMBUS[0], y - NIMBUS[1])
    angle = np.arctan2(y - NIMBUS[1], x - NIMBUS[0])
    rays = 0.16 * np.abs(np.sin(24.0 * angle)) * smooth_step((from_middle - 10.0) / 3.0)
    ring = 0.5 * half_round((from_middle - NIMBUS[2] + 0.7) / 0.7)
    to_punch = np.hypot((from_middle - NIMBUS[2] + 2.3) / 0.55, (np.mod(angle * 24.0 / np.pi, 1.0) - 0.5) * 4.0)
    nimbus = FIELD_MM + 0.15 + rays * (from_middle < NIMBUS[2] - 3.2) + ring
    nimbus -= 0.25 * np.sqrt(np.maximum(0.0, 1.0 - to_punch**2))
    field = FIELD_MM - 0.6 + 0.03 * noise(x, y, 0.8, 3)
    height = np.where(from_middle < NIMBUS[2], nimbus, field)
    return np.maximum(np.maximum(height, cloak_mm(x, y)), head_mm(x, y))


def _rope(x: Array, y: Array) -> Array:
    """Height of a twisted rope around the roundel; 0 outside it."""
    radius, angle = np.hypot(x - ROUNDEL[0], y - ROUNDEL[1]), np.arctan2(y - ROUNDEL[1], x - ROUNDEL[0])
    offset = (radius - ROUNDEL[2] - ROPE_MM) / ROPE_MM
    strand = np.abs(np.sin(30.0 * angle + 1.4 * offset)) ** 0.6
    profile = half_round(offset) * (1.35 + 0.75 * strand)
    return np.where(np.abs(offset) < 1.0, FIELD_MM + profile, 0.0)


def _flowers(x: Array, y: Array) -> Array:
    """Height of a flower in each corner around the roundel; 0 outside the flowers."""
    r, phi = _flower_place(x, y)
    petal = 3.9 * (0.62 + 0.38 * np.abs(np.cos(2.5 * phi)))
    leaf = 1.5 * np.sqrt(np.maximum(0.0, 1.0 - (r / petal) ** 2)) * (0.75 + 0.25 * np.cos(10.0 * phi))
    return np.where(r < petal, FIELD_MM + np.maximum(leaf, 1.7 * half_round(r / 1.0)), 0.0)


def in_flower(x: Array, y: Array) -> Mask:
    """True on the flowers around the roundel."""
    r, phi = _flower_place(x, y)
    return r < 3.9 * (0.62 + 0.38 * np.abs(np.cos(2.5 * phi)))


def _flower_place(x: Array, y: Array) -> tuple[Array, Array]:
    """Distance to the nearest flower's middle, and the angle about it."""
    to_x, to_y = np.abs(x - ROUNDEL[0]) - 24.9, np.abs(y - ROUNDEL[1]) - 25.2
    return np.hypot(to_x, to_y), np.arctan2(to_y, to_x)


def _bars(x: Array, y: Array) -> Array:
    """Half-round bars between bays and band."""
    upright = half_round((np.abs(x) - _BAR_X_MM) / _BAR_HALF_MM) * (y > _BAR_Y_MM)
    lying = half_round((y - _BAR_Y_MM) / _BAR_HALF_MM)
    return FIELD_MM + 1.5 * np.maximum(upright, lying)


def on_bar(x: Array, y: Array) -> Mask:
    """True on the bars between bays and band."""
    upright = (np.abs(np.abs(x) - _BAR_X_MM) < _BAR_HALF_MM) & (y > _BAR_Y_MM)
    return upright | (np.abs(y - _BAR_Y_MM) < _BAR_HALF_MM)


def _lacquer(x: Array, y: Array) -> Array:
    """A flat panel with a rounded edge and a raised drawing."""
    edge_mm = 1.6 * np.sqrt(1.0 - (1.0 - np.clip(_inside(x, y, LACQUER_MM) / 0.9, 0.0, 1.0)) ** 2)
    swell = 0.03 * np.cos(0.21 * x) * np.cos(0.13 * y)
    return FIELD_MM + edge_mm + swell + plum_branch.raised_mm(*panel_place(x, y))


def panel_place(x: Array, y: Array) -> tuple[Array, Array]:
    """Places about the middle of the panel of lacquer."""
    west, east, south, north = LACQUER_MM
    return x - 0.5 * (west + east), y - 0.5 * (south + north)


def _band(x: Array, y: Array) -> Array:
    """The raised band, with the strokes cut into it."""
    face_mm = FIELD_MM + 1.3 * smooth_step(_inside(x, y, BAND_MM) / 0.8) + 0.008 * noise(x, y, 0.4, 4)
    return face_mm - _cut_depth(x, y)


def _cut_depth(x: Array, y: Array) -> Array:
    """Depth of the strokes, with a rounded bottom."""
    return STROKE_DEPTH_MM * half_round(np.minimum(cut_distance(x, y) / (0.5 * STROKE_MM), 2.0))


def _frame(x: Array, y: Array) -> Array:
    """Egg and dart between a fillet and a row of beads."""
    inset, along = edge_distance(x, y), _along_edge(x, y) % _EGG_MM - 0.5 * _EGG_MM
    profile = FIELD_MM + 0.4 + 2.8 * np.sqrt(1.0 - (np.clip(inset - 0.9, 0.0, 3.3) / 3.4) ** 2)
    profile = np.where(inset < 0.9, FIELD_MM + 3.9 * smooth_step((inset + 0.25) / 0.5), profile)
    egg_squared = (along / 1.15) ** 2 + ((inset - 2.5) / 1.55) ** 2
    egg = 1.3 * np.sqrt(np.maximum(0.0, 1.0 - egg_squared))
    shell = 0.55 * half_round((np.sqrt(egg_squared) - 1.28) / 0.16) * (inset > 0.9)
    dart = 0.9 * np.maximum(0.0, 1.0 - (2.0 - np.abs(along)) / 0.34) * ((inset > 1.2) & (inset < 3.9))
    relief_mm = profile + np.where(
        (inset > 0.9) & (inset < 4.2), np.maximum(np.maximum(egg, shell), dart) - 0.7, 0.0
    )
    relief_mm = np.where(inset > 4.2, FIELD_MM + 0.4 + bead_mm(x, y)[0], relief_mm)
    return relief_mm + 0.02 * noise(x, y, 0.5, 5)


def _along_edge(x: Array, y: Array) -> Array:
    """Return the place along the nearest edge, from its middle. Patterns of this place are complete at the
    corners."""
    beside = 0.5 * PLAQUE_MM[0] - np.abs(x) < 0.5 * PLAQUE_MM[1] - np.abs(y)
    return np.where(beside, y, x) + 1000.0 * _EGG_MM + np.where(beside, 0.5 * _EGG_MM, 0.0)


def _inside(x: Array, y: Array, box_mm: tuple[float, float, float, float]) -> Array:
    """Distance to the edge of a box (left, right, bottom, top), positive inside."""
    west, east, south, north = box_mm
    return np.minimum(np.minimum(x - west, east - x), np.minimum(y - south, north - y))

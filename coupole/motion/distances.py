"""Compiled distances between an arm made of spheres and its obstacles; the interface is `motion.collisions`.

Every obstacle is a signed distance function of a point, negative inside. Its value never changes by more than the
point moves. So the search for the least distance to a tree of spheres visits only nodes whose bounding sphere may
be nearer than the least distance so far.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

DISK, DOME, SPHERE, BOX, SHAPE = range(5)
"""Kinds of obstacles: the disk and everything below it, the dome and everything beyond it, keep-outs, a tree of
spheres."""
SUPPORT_FRAME = 8
"""Index of the support's frame among the links' (0 the base, 1 to 6 the links, 7 the flange)."""
RESOLUTION_MM = 2.0
"""A segment of a motion that is as short as this, and is not shown to be clear, counts as blocked."""
ROUNDING_MM = 1e-9
CLEAR = -1


class Model(NamedTuple):
    """Arm, shapes and checked pairs, as arrays."""

    base: NDArray[np.float64]
    """[4, 4] `support_from_base`, mm."""
    joints: NDArray[np.float64]
    """[6, 5] for each joint: its origin in the frame of the previous link (mm), its sense (1 or -1) and its axis
    (0 x, 1 y, 2 z)."""
    flange: NDArray[np.float64]
    """[4, 4] `link_6_from_flange`, mm."""
    nodes: NDArray[np.float64]
    trees: NDArray[np.int64]
    """The `SphereTrees` of all shapes."""
    numbers: NDArray[np.int64]
    """[pairs, 6] number of a tree, and of its link; the kind of obstacle; for SHAPE, number of the other tree,
    and of its link; the link relative to which the tree moves (0 if the obstacle is fixed).
    """
    figures: NDArray[np.float64]
    """[pairs, 13] 0: clearance, mm; 1 to 6: largest relative motion of the two per radian of each axis, mm; 7 on:
    DISK radius; DOME radius, sine and cosine of the opening's elevation; SPHERE centre, radius; BOX lowest and
    highest corner."""


# Indexed by numbers, not by rows and slices: this saves seconds of compile time.


@kernel
def place_links(base, joints, flange, joints_deg, frames):  # type: ignore[no-untyped-def]
    """Fill `frames` [9, 3, 4], rotation and origin of each link's frame in the support frame."""
    for r in range(3):
        for q in range(4):
            frames[0, r, q] = base[r, q]
            frames[SUPPORT_FRAME, r, q] = 1.0 if r == q else 0.0
    for k in range(6):
        angle = joints[k, 3] * joints_deg[k] * (np.pi / 180.0)
        c, s = np.cos(angle), np.sin(angle)
        axis = int(joints[k, 4])
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for r in range(3):
            frames[k + 1, r, axis] = frames[k, r, axis]
            frames[k + 1, r, i] = c * frames[k, r, i] + s * frames[k, r, j]
            frames[k + 1, r, j] = c * frames[k, r, j] - s * frames[k, r, i]
            frames[k + 1, r, 3] = frames[k, r, 3]
            for q in range(3):
                frames[k + 1, r, 3] += frames[k, r, q] * joints[k, q]
    for r in range(3):
        for q in range(4):
            frames[7, r, q] = frames[6, r, 3] if q == 3 else 0.0
            for p in range(3):
                frames[7, r, q] += frames[6, r, p] * flange[p, q]


@kernel
def _length(x, y, z):  # type: ignore[no-untyped-def]
    return np.sqrt(x * x + y * y + z * z)


@kernel
def _to_solid(kind, figures, pair, x, y, z):  # type: ignore[no-untyped-def]
    """Return the distance of a point of the support frame to a DISK, DOME, SPHERE or BOX; negative inside."""
    f0, f1, f2, f3 = figures[pair, 7], figures[pair, 8], figures[pair, 9], figures[pair, 10]
    if kind == SPHERE:
        return _length(x - f0, y - f1, z - f2) - f3
    if kind == BOX:
        out_x = max(f0 - x, x - f3)
        out_y = max(f1 - y, y - figures[pair, 11])
        out_z = max(f2 - z, z - figures[pair, 12])
        deepest = max(out_x, out_y, out_z)
        return deepest if deepest <= 0.0 else _length(max(out_x, 0.0), max(out_y, 0.0), max(out_z, 0.0))
    out = _length(x, y, 0.0)
    if kind == DISK:
        beside = out - f0
        return max(beside, z) if beside <= 0.0 or z <= 0.0 else _length(beside, z, 0.0)
    along, above = out * f2 + z * f1, z * f2 - out * f1  # distance from the ray through the rim of the opening
    if above > 0.0:
        return above if along >= f0 else _length(along - f0, above, 0.0)
    inside = f0 - _length(out, z, 0.0)
    # everything beyond the shell is forbidden
    return max(inside, above) if inside < 0.0 and along > f0 else inside


@kernel
def _after(i):  # type: ignore[no-untyped-def]
    """Return the node that follows node i and all nodes below it; 0 after the last."""
    while i & 1:
        i >>= 1
    return i + 1 if i else 0


@kernel
def _to_node(nodes, n, x, y, z):  # type: ignore[no-untyped-def]
    return _length(x - nodes[n, 0], y - nodes[n, 1], z - nodes[n, 2]) - nodes[n, 3]


@kernel
def _to_tree(nodes, begin, first_leaf, x, y, z, best, hasty):  # type: ignore[no-untyped-def]
    """Return the distance of a point, in the tree's own frame, to the nearest sphere of the tree, at most `best`.
    If `hasty`, it is the distance to the first sphere found that is nearer than `best`."""
    if _to_node(nodes, begin + 1, x, y, z) >= best:
        return best
    i = 1
    while i < first_leaf:
        nearer = _to_node(nodes, begin + 2 * i, x, y, z) <= _to_node(nodes, begin + 2 * i + 1, x, y, z)
        i = 2 * i if nearer else 2 * i + 1
    away = _to_node(nodes, begin + i, x, y, z)
    if away < best and hasty:
        return away
    best = min(best, away)
    i = 1
    while i:
        away = _to_node(nodes, begin + i, x, y, z)
        if away >= best:
            i = _after(i)
        elif i < first_leaf:
            i *= 2
        elif hasty:
            return away
        else:
            best = away
            i = _after(i)
    return best


@kernel
def _to_obstacle(nodes, trees, numbers, figures, frames, pair, n, best, hasty):  # type: ignore[no-untyped-def]
    """Return the distance of node n, in the frame of the pair's link, to the pair's obstacle, at most `best`.
    `hasty` works as in `_to_tree`."""
    link, obstacle_link = numbers[pair, 1], numbers[pair, 4]
    bx, by, bz, radius = nodes[n, 0], nodes[n, 1], nodes[n, 2], nodes[n, 3]
    x = frames[link, 0, 0] * bx + frames[link, 0, 1] * by + frames[link, 0, 2] * bz + frames[link, 0, 3]
    y = frames[link, 1, 0] * bx + frames[link, 1, 1] * by + frames[link, 1, 2] * bz + frames[link, 1, 3]
    z = frames[link, 2, 0] * bx + frames[link, 2, 1] * by + frames[link, 2, 2] * bz + frames[link, 2, 3]
    if numbers[pair, 2] != SHAPE:
        return _to_solid(numbers[pair, 2], figures, pair, x, y, z) - radius
    x, y, z = x - frames[obstacle_link, 0, 3], y - frames[obstacle_link, 1, 3], z - frames[obstacle_link, 2, 3]
    own_x = frames[obstacle_link, 0, 0] * x + frames[obstacle_link, 1, 0] * y + frames[obstacle_link, 2, 0] * z
    own_y = frames[obstacle_link, 0, 1] * x + frames[obstacle_link, 1, 1] * y + frames[obstacle_link, 2, 1] * z
    own_z = frames[obstacle_link, 0, 2] * x + frames[obstacle_link, 1, 2] * y + frames[obstacle_link, 2, 2] * z
    tree = numbers[pair, 3]
    return _to_tree(nodes, trees[tree, 0], trees[tree, 1], own_x, own_y, own_z, best + radius, hasty) - radius


@kernel
def _margin(nodes, trees, numbers, figures, frames, pair, far, hasty):  # type: ignore[no-untyped-def]
    """Return the least distance of a pair minus its clearance, at most `far`. If `hasty`, it is the first value
    found below `far`."""
    begin, first_leaf = trees[numbers[pair, 0], 0], trees[numbers[pair, 0], 1]
    clearance_mm = figures[pair, 0]
    best = far
    i = 1
    while i:
        bound_mm = best + clearance_mm
        margin = (
            _to_obstacle(nodes, trees, numbers, figures, frames, pair, begin + i, bound_mm, hasty) - clearance_mm
        )
        if margin > best - ROUNDING_MM:
            i = _after(i)
        elif i < first_leaf:
            i *= 2
        elif hasty:
            return margin
        else:
            best = margin
            i = _after(i)
    return best


@kernel
def _moved_mm(nodes, trees, numbers, figures, joints, frames, pair, turns_rad):  # type: ignore[no-untyped-def]
    """Return a bound of the relative motion of a pair while the axes turn by at most `turns_rad` [6] from a
    posture.

    The motion of a point is bounded by a sum over the axes: the turn of an axis times the point's greatest
    distance from it during the turn. This distance is at most the present one plus the point's motion by the axes
    farther out.
    """
    n, link = trees[numbers[pair, 0], 0] + 1, numbers[pair, 1]
    bx, by, bz, radius = nodes[n, 0], nodes[n, 1], nodes[n, 2], nodes[n, 3]
    x = frames[link, 0, 0] * bx + frames[link, 0, 1] * by + frames[link, 0, 2] * bz + frames[link, 0, 3]
    y = frames[link, 1, 0] * bx + frames[link, 1, 1] * by + frames[link, 1, 2] * bz + frames[link, 1, 3]
    z = frames[link, 2, 0] * bx + frames[link, 2, 1] * by + frames[link, 2, 2] * bz + frames[link, 2, 3]
    motion_mm = 0.0
    for k in range(min(link, 6) - 1, numbers[pair, 5] - 1, -1):
        axis = int(joints[k, 4])
        ux, uy, uz = frames[k + 1, 0, axis], frames[k + 1, 1, axis], frames[k + 1, 2, axis]
        dx, dy, dz = x - frames[k + 1, 0, 3], y - frames[k + 1, 1, 3], z - frames[k + 1, 2, 3]
        away = _length(uy * dz - uz * dy, uz * dx - ux * dz, ux * dy - uy * dx)
        motion_mm += turns_rad[k] * min(figures[pair, 1 + k], away + radius + motion_mm)
    return motion_mm


@kernel
def margins_at(model, joints_deg, far_mm):  # type: ignore[no-untyped-def]
    """Return the distance minus clearance [n, pairs] with the arm at `joints_deg` [n, 6], at most `far_mm`."""
    frames = np.empty((9, 3, 4))
    margins = np.empty((joints_deg.shape[0], model.numbers.shape[0]))
    for n in range(margins.shape[0]):
        place_links(model.base, model.joints, model.flange, joints_deg[n], frames)
        for pair in range(margins.shape[1]):
            margins[n, pair] = _margin(
                model.nodes, model.trees, model.numbers, model.figures, frames, pair, far_mm, False
            )
    return margins


@kernel
def blocked_at(model, start_deg, end_deg):  # type: ignore[no-untyped-def]
    """Return the first pair that is found to come too close on a straight motion in joint space, or CLEAR. Also
    return its parameter on the motion (0 to 1), and the bound of the pair's relative motion within the checked
    segment, mm.

    A segment is clear if the distance of each pair at the segment's middle is larger than its possible approach up
    to the segment's ends. Other segments are halved.
    """
    numbers, figures = model.numbers, model.figures
    frames, here_deg, turns_rad = np.empty((9, 3, 4)), np.empty(6), np.empty(6)
    most_mm = 0.0
    for pair in range(numbers.shape[0]):
        motion_mm = 0.0
        for k in range(6):
            motion_mm += figures[pair, 1 + k] * abs(end_deg[k] - start_deg[k]) * (np.pi / 180.0)
        most_mm = max(most_mm, motion_mm)
    size = int(2.0 * most_mm / RESOLUTION_MM) + 4
    middles, unclear = np.empty(size), np.empty(size)
    middles[0], count, half = 0.5, 1, 0.5
    while count:
        unclear_count = 0
        for k in range(6):
            turns_rad[k] = half * abs(end_deg[k] - start_deg[k]) * (np.pi / 180.0)
        for m in range(count):
            for k in range(6):
                here_deg[k] = start_deg[k] + middles[m] * (end_deg[k] - start_deg[k])
            place_links(model.base, model.joints, model.flange, here_deg, frames)
            for pair in range(numbers.shape[0]):
                first = pair == 0 or numbers[pair, 0] != numbers[pair - 1, 0]
                if first or numbers[pair, 5] != numbers[pair - 1, 5]:
                    motion_mm = _moved_mm(
                        model.nodes, model.trees, numbers, figures, model.joints, frames, pair, turns_rad
                    )
                margin = _margin(model.nodes, model.trees, numbers, figures, frames, pair, motion_mm, True)
                if margin == motion_mm:
                    continue
                if margin < 0.0 or motion_mm < RESOLUTION_MM:
                    return pair, middles[m], motion_mm
                unclear[unclear_count] = middles[m]
                unclear_count += 1
                break
        half /= 2.0
        for m in range(unclear_count):
            middles[2 * m], middles[2 * m + 1] = unclear[m] - half, unclear[m] + half
        count = 2 * unclear_count
    return CLEAR, 0.0, 0.0

"""Assigns spots to LEDs, from views at several poses, and names the fault of an LED found at another place.

Each LED is lit alone, so a frame's spots are the LED and its reflections. Every two spots of different views give
a point in space. The point that most views agree with is the LED, if it lies near a place of the table (a mirror
image lies behind the mirror). An LED that lights at another's place is found there, which shows how it is wired.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.calibration.leds.boards import Boards
from coupole.calibration.multi_view import unproject
from coupole.calibration.optics import Intrinsics
from coupole.calibration.point_sets import Indices, rigid_motion
from coupole.calibration.record import LedFault
from coupole.calibration.rotations import Floats, rotation_vector

LEAST_VIEWS = 3
"""Two rays often nearly intersect by chance; a third one confirms the point."""
_NEAREST_MM, _FARTHEST_MM = 150.0, 4000.0
_LEAST_SINE = 0.02
_RIGID_MM = 5.0
"""Points that fit a board's layout within this distance are taken for this board, with its LEDs in the right
order."""
_MOST_TURN_DEG = 60.0
"""A board of 2 x 3 LEDs rotated by 180 degrees looks like a board that is wired backwards; wrong wiring is more
likely."""


@dataclass(frozen=True)
class LedSightings:
    """All spots of a run: spot k was seen in view `view[k]` while the LED in row `led[k]` of the table was lit."""

    view: Indices
    led: Indices
    pixels: Floats
    """[k, 2]."""
    covariance: Floats
    """[k, 2, 2], px^2."""
    frames: NDArray[np.intp]
    """[m, 2] view and LED of every frame, also of frames without spots."""

    def only(self, keep: Indices) -> LedSightings:
        return LedSightings(self.view[keep], self.led[keep], self.pixels[keep], self.covariance[keep], self.frames)


@dataclass(frozen=True)
class Matching:
    """The place of each LED."""

    found_mm: Floats
    """[n, 3] centres in the base frame, in the order of the table; NaN for an LED that was not found."""
    place_of: Indices
    """[n] place at which each LED lights, -1 if none."""
    sightings: LedSightings
    """Spots that agree; their `led` is still the LED that was lit."""
    faults: tuple[LedFault, ...]

    @property
    def by_place_mm(self) -> Floats:
        """[n, 3] position found at each place; NaN where no LED was found."""
        there = np.full_like(self.found_mm, np.nan)
        rows = np.flatnonzero(self.place_of >= 0)
        there[self.place_of[rows]] = self.found_mm[rows]
        return there


def match_leds(
    sightings: LedSightings,
    base_from_camera: Floats,
    lens: Intrinsics,
    ids: NDArray[np.int64],
    boards: Boards,
    *,
    tolerance_px: float,
    reach_mm: float = 150.0,
) -> Matching:
    """Find each LED in space and at a place of the table.

    `base_from_camera` [v, 4, 4] are the views' poses; `reach_mm` is the largest distance of an LED from a place of
    the table.
    """
    table_mm = boards.in_base(boards.base_from_board)
    rays = np.einsum("kij,kj->ki", base_from_camera[sightings.view, :3, :3], unproject(sightings.pixels, lens))
    eyes_mm = base_from_camera[sightings.view, :3, 3]
    tolerance_rad = tolerance_px / lens.fx
    found_mm = np.full((len(ids), 3), np.nan)
    agreeing: list[NDArray[np.intp]] = []
    near = cKDTree(table_mm)
    order = np.argsort(sightings.led, kind="stable")
    for led_rows in np.split(order, np.flatnonzero(np.diff(sightings.led[order])) + 1) if len(order) else []:
        inside = _agreeing(
            rays[led_rows], eyes_mm[led_rows], sightings.view[led_rows], tolerance_rad, near, reach_mm
        )
        if len(inside):
            rows = led_rows[inside]
            found_mm[sightings.led[rows[0]]] = _meeting(rays[rows], eyes_mm[rows])
            agreeing.append(rows)
    agreeing_sightings = sightings.only(np.concatenate(agreeing) if agreeing else np.zeros(0, np.intp))
    place_of, wiring = _places(found_mm, table_mm, ids, boards)
    return Matching(found_mm, place_of, agreeing_sightings, (*_unseen(sightings, found_mm, ids), *wiring))


def _agreeing(
    rays: Floats, eyes_mm: Floats, views: Indices, tolerance_rad: float, near: cKDTree, reach_mm: float
) -> Indices:
    """Return the spots of one LED, at most one of each view, that agree with one point; empty if there is no such
    point."""
    a, b = np.triu_indices(len(rays), 1)
    apart = views[a] != views[b]
    a, b = a[apart], b[apart]
    points, good = _crossings(rays[a], eyes_mm[a], rays[b], eyes_mm[b])
    points = points[good]
    if len(points):
        points = points[near.query(points)[0] < reach_mm]
    if not len(points):
        return np.zeros(0, np.intp)
    for _ in range(2):
        off = _off(points, rays, eyes_mm) / tolerance_rad
        score = np.maximum(1 - off**2, 0.0)
        by_view = np.stack([score[:, views == view].max(axis=1) for view in np.unique(views)], axis=1)
        best = int(np.argmax(by_view.sum(axis=1)))
        inside = _nearest_of_each_view(off[best], views)
        if len(inside) < LEAST_VIEWS:
            return np.zeros(0, np.intp)
        points = _meeting(rays[inside], eyes_mm[inside])[None]
    return inside


def _crossings(rays_a: Floats, eyes_a: Floats, rays_b: Floats, eyes_b: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the midpoints [n, 3] of the shortest connections of pairs of rays, and a mask [n] of those that lie
    in front of both cameras and at a sufficient angle of intersection."""
    apart = eyes_b - eyes_a
    cosine = np.einsum("ni,ni->n", rays_a, rays_b)
    along_a, along_b = np.einsum("ni,ni->n", rays_a, apart), np.einsum("ni,ni->n", rays_b, apart)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    middles = (eyes_a + s[:, None] * rays_a + eyes_b + t[:, None] * rays_b) / 2
    nearest, farthest = np.minimum(s, t), np.maximum(s, t)
    return middles, (nearest > _NEAREST_MM) & (farthest < _FARTHEST_MM) & (sine2 > _LEAST_SINE**2)


def _off(points: Floats, rays: Floats, eyes_mm: Floats) -> Floats:
    """Return the tangents [points, rays] of the angles between points and rays, as seen from the camera."""
    to_point = points[:, None] - eyes_mm[None]
    along = np.einsum("pki,ki->pk", to_point, rays)
    across = np.linalg.norm(to_point - along[..., None] * rays, axis=2)
    return np.asarray(np.where(along > 0, across / np.maximum(along, 1e-9), np.inf))


def _nearest_of_each_view(off: Floats, views: Indices) -> Indices:
    nearest = [
        rows[int(np.argmin(off[rows]))] for view in np.unique(views) if len(rows := np.flatnonzero(views == view))
    ]
    inside = np.array(nearest, dtype=np.intp)
    return inside[off[inside] < 1.0]


def _meeting(rays: Floats, eyes_mm: Floats) -> Floats:
    """Return the point [3] that is nearest to the rays (least squares of angles, weights from one iteration)."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weight = np.ones(len(rays))
    for _ in range(2):
        weighted_across = across * weight[:, None, None]
        point = np.linalg.solve(weighted_across.sum(axis=0), np.einsum("nij,nj->i", weighted_across, eyes_mm))
        weight = 1.0 / np.sum((point - eyes_mm) ** 2, axis=1)
    return np.asarray(point)


# -- faults -----------------------------------------------------------------------------------------------


def _unseen(sightings: LedSightings, found_mm: Floats, ids: NDArray[np.int64]) -> Iterator[LedFault]:
    spots = np.bincount(sightings.led, minlength=len(ids))
    views = np.bincount(np.unique(np.stack([sightings.led, sightings.view]), axis=1)[0], minlength=len(ids))
    frames = np.bincount(sightings.frames[:, 1], minlength=len(ids))
    for row in np.flatnonzero(np.isnan(found_mm[:, 0])):
        led = int(ids[row])
        if not frames[row]:
            yield LedFault("few", (led,), f"LED {led}: no frame shows it. Take views for it")
        elif not spots[row]:
            yield LedFault(
                "dead", (led,), f"LED {led}: dead: no spot in any of {frames[row]} frames. Look at its wire"
            )
        elif views[row] < LEAST_VIEWS:
            yield LedFault(
                "few",
                (led,),
                f"LED {led}: seen in {views[row]} of {frames[row]} views, {LEAST_VIEWS} needed. Take more views",
            )
        else:
            yield LedFault(
                "astray",
                (led,),
                f"LED {led}: the spots of {views[row]} views meet in no point near the dome: they are "
                "reflections, or the camera's poses are wrong",
            )


def _places(
    found_mm: Floats, table_mm: Floats, ids: NDArray[np.int64], boards: Boards
) -> tuple[Indices, list[LedFault]]:
    """Return the place at which each LED lights, and the faults of boards and wires that follow from this."""
    here = np.where(np.isfinite(found_mm[:, 0]), np.arange(len(ids)), -1)
    tree = cKDTree(table_mm)
    spacing_mm = float(np.median(tree.query(table_mm, 2)[0][:, 1])) if len(table_mm) > 1 else np.inf
    near_mm = 0.4 * spacing_mm
    off_mm = np.linalg.norm(found_mm - table_mm, axis=1)
    astray = np.flatnonzero(off_mm > near_mm)
    moved_boards = [
        b
        for b in np.unique(boards.board_of[astray])
        if _is_moved_board(boards.rows_of(b), found_mm, table_mm)
        and not _on_another(b, found_mm, tree, near_mm, boards)
    ]
    faults = []
    for row in astray[~np.isin(boards.board_of[astray], moved_boards)]:
        distance_mm, place = tree.query(found_mm[row])
        here[row] = place if distance_mm < near_mm else -1
        if here[row] < 0:
            led = int(ids[row])
            text = (
                f"LED {led}: found {off_mm[row]:.1f} mm from its place, and not at the place of another LED. "
                "Look at its mount"
            )
            faults.append(LedFault("astray", (led,), text))
    twice = [p for p in np.unique(here[here >= 0]) if np.sum(here == p) > 1]
    for place in twice:
        rows = np.flatnonzero(here == place)
        leds = tuple(int(ids[row]) for row in rows)
        text = (
            f"LEDs {' and '.join(map(str, leds))} light at the same place: the place of LED {ids[place]}. Look at "
            "the wires"
        )
        faults.append(LedFault("miswired", leds, text))
        here[rows[rows != place]] = -1
    return here, faults + list(_wiring(here, ids, boards))


def _is_moved_board(rows: Indices, found_mm: Floats, table_mm: Floats) -> bool:
    """True if the LEDs of a board have the table's layout in the right order: then the board was moved and its
    wiring is right."""
    rows = rows[np.isfinite(found_mm[rows, 0])]
    if len(rows) < LEAST_VIEWS:
        return False
    motion = rigid_motion(table_mm[rows], found_mm[rows])
    off = table_mm[rows] @ motion[:3, :3].T + motion[:3, 3] - found_mm[rows]
    turn_deg = np.degrees(np.linalg.norm(rotation_vector(motion[:3, :3])))
    return bool(np.abs(off).max() < _RIGID_MM and turn_deg < _MOST_TURN_DEG)


def _on_another(board: int, found_mm: Floats, tree: cKDTree, near_mm: float, boards: Boards) -> bool:
    """True if all LEDs of a board light at places of another one: their plugs are exchanged."""
    rows = boards.rows_of(board)
    off_mm, place = tree.query(found_mm[rows[np.isfinite(found_mm[rows, 0])]])
    there = np.unique(boards.board_of[place])
    return bool((off_mm < near_mm).all() and len(there) == 1 and there[0] != board)


def _wiring(here: Indices, ids: NDArray[np.int64], boards: Boards) -> Iterator[LedFault]:
    """Yield cycles of LEDs that light at each other's places. Two LEDs are swapped; more LEDs mean a mis-wired
    board."""
    for ring in _rings(here):
        leds = tuple(int(ids[row]) for row in ring)
        on = sorted({int(boards.numbers[boards.board_of[row]]) for row in (*ring, int(here[ring[-1]]))})
        where = f"on board {on[0]}" if len(on) == 1 else f"on boards {', '.join(map(str, on))}"
        if len(ring) == 2 and here[ring[1]] == ring[0]:
            yield LedFault("swapped", leds, f"LEDs {leds[0]} and {leds[1]} are swapped, {where}. Swap their wires")
        else:
            chain = " -> ".join(map(str, (*leds, int(ids[here[ring[-1]]]))))
            yield LedFault(
                "miswired", leds, f"mis-wired {where}: each of LEDs {chain} is at the place of the next one"
            )


def _rings(here: Indices) -> Iterator[list[int]]:
    """Yield cycles of rows that light at each other's places, and an open chain if one LED was not found."""
    todo = {int(row) for row in np.flatnonzero((here >= 0) & (here != np.arange(len(here))))}
    while todo:
        ring = [min(todo - {int(here[row]) for row in todo}, default=min(todo))]
        while (after := int(here[ring[-1]])) in todo and after not in ring:
            ring.append(after)
        todo.difference_update(ring)
        yield ring


def fault_lines(faults: Sequence[LedFault]) -> tuple[str, ...]:
    """Return the faults as text; all dead LEDs share one line."""
    dead = [fault.leds[0] for fault in faults if fault.kind == "dead"]
    if len(dead) < 4:
        return tuple(fault.text for fault in faults)
    other_lines = tuple(fault.text for fault in faults if fault.kind != "dead")
    return (f"{len(dead)} LEDs are dead: no frame shows their spot: {', '.join(map(str, dead))}", *other_lines)

"""Selects the LEDs of a plan's `lights:` in a dome's table."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, direction, farthest_first, inverse
from coupole.plan.led_table import LedTable
from coupole.plan.plan import Plan
from coupole.plan.plan_lights import (
    AdaptiveLights,
    AllLights,
    EveryLight,
    LightBoards,
    LightCone,
    LightIds,
    Lights,
    NoLights,
    Panels,
)
from coupole.plan.shot_id import Led, Panel
from coupole.plan.watch import SENTINELS


def leds_of_plan(plan: Plan, leds: LedTable, base_from_support: Transform) -> NDArray[np.int64]:
    """Return the rows of the LED table that any view of the plan lights. Raises KeyError like `select_leds`."""
    rows = [select_leds(view.lights or plan.lights, leds, base_from_support) for view in plan.view_entries]
    return np.unique(np.concatenate(rows))


def select_leds(lights: Lights, leds: LedTable, base_from_support: Transform) -> NDArray[np.int64]:
    """Return the rows of the LED table that are lit, in the order of the table; none for panels and darks.

    Raises KeyError for an LED or a board that the dome does not have (`missing_lights` gives messages).
    """
    match lights:
        case AllLights():
            return np.arange(len(leds.ids))
        case LightIds(ids=ids):
            return leds.rows(ids)
        case LightBoards(boards=boards):
            if unknown := set(boards) - set(leds.boards.tolist()):
                raise KeyError(min(unknown))
            return np.flatnonzero(np.isin(leds.boards, boards))
        case EveryLight(every=every, offset=offset):
            return np.arange(offset, len(leds.ids), every)
        case LightCone() as cone:
            position = (leds.positions_mm - base_from_support[:3, 3]) @ inverse(base_from_support)[:3, :3].T
            towards = position / np.linalg.norm(position, axis=1, keepdims=True)
            cosine = towards @ direction(cone.azimuth_deg, cone.elevation_deg)
            return np.flatnonzero(cosine >= np.cos(np.radians(cone.half_angle_deg)))
        case AdaptiveLights(among=among):
            return select_leds(among, leds, base_from_support)
        case Panels() | NoLights():
            return np.zeros(0, np.int64)
        case _:
            assert_never(lights)


def lit_in_bursts(lights: Lights, leds: LedTable, base_from_support: Transform) -> list[Sequence[Led] | Panel]:
    """Return the lights of each burst of one exposure. There is one burst for all LEDs, in which neighbours in
    time are on different boards, or one burst for each panel. Raises KeyError like `select_leds`."""
    match lights:
        case AllLights() | LightIds() | LightBoards() | EveryLight() | LightCone() | AdaptiveLights() | NoLights():
            rows = select_leds(lights, leds, base_from_support)
            return [[Led(int(led)) for led in leds.ids[rows[interleave(leds.boards[rows])]]]]
        case Panels(panels=panels):
            return [Panel(number) for number in panels]
        case _:
            assert_never(lights)


FEWEST_WATCHED = 12
"""Least number of LEDs of a view that has sentinels."""
FEWEST_FIRST_LIGHTS, FIRST_SHARE = 6, 8


def first_lights(ids: NDArray[np.int64], leds: LedTable, most: int) -> NDArray[np.int64]:
    """Return ids of LEDs among `ids` [n] for a first pass, spread over the dome. Their number is `most`, but at
    most an eighth of `ids`, and at least six.
    """
    count = min(len(ids), most, max(FEWEST_FIRST_LIGHTS, len(ids) // FIRST_SHARE))
    return ids[spread_rows(leds.positions_mm[leds.rows(ids)], count)] if len(ids) else ids


def sentinels_among(lit: Sequence[Sequence[Led] | Panel], leds: LedTable) -> tuple[int, ...]:
    """Return the ids of a view's sentinels. They are spread over the middle half of the `lit` LEDs, by height.
    The light of low LEDs is grazing, and the highest LEDs are alike. No sentinels are returned if too few LEDs
    are lit to place sentinels between them.
    """
    ids = np.array([led.id for lights in lit if not isinstance(lights, Panel) for led in lights], np.int64)
    if len(ids) < FEWEST_WATCHED:
        return ()
    heights_mm = leds.positions_mm[leds.rows(ids)] @ leds.normals.mean(axis=0)
    order = np.argsort(heights_mm, kind="stable")
    middle = np.sort(ids[order[len(ids) // 4 : len(ids) - len(ids) // 4]])
    rows = spread_rows(leds.positions_mm[leds.rows(middle)], SENTINELS)
    return tuple(middle[rows].tolist())


def spread_rows(positions_mm: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the rows of `count` positions [n, 3], each as far as possible from the positions before it."""
    return np.array(sorted(row for row, _ in islice(farthest_first(positions_mm, 0), count)))


def missing_lights(
    plan: Plan, leds: LedTable, base_from_support: Transform
) -> list[tuple[tuple[str | int, ...], str]]:
    """Return key path and message for each light of the plan that the dome does not have, and for a cone without
    any LED."""
    view_lights = [
        ((*plan.views_key, i, "lights"), view.lights)
        for i, view in enumerate(plan.view_entries)
        if view.lights is not None
    ]
    return [
        (where + key, message)
        for where, lights in [(("lights",), plan.lights), *view_lights]
        for key, message in _missing(lights, leds, base_from_support)
    ]


def _missing(
    lights: Lights, leds: LedTable, base_from_support: Transform
) -> list[tuple[tuple[str | int, ...], str]]:
    match lights:
        case LightIds(ids=ids):
            have, key, noun = set(leds.ids.tolist()), "ids", "LED"
            numbers: tuple[int, ...] = ids
        case LightBoards(boards=boards):
            have, key, noun, numbers = set(leds.boards.tolist()), "boards", "board", boards
        case EveryLight(offset=offset) if offset >= len(leds.ids):
            return [(("offset",), f"expected less than the dome's {len(leds.ids)} LEDs, found {offset}")]
        case LightCone() if not len(select_leds(lights, leds, base_from_support)):
            return [((), "expected lights, none of the dome's LEDs lies in that cone")]
        case AdaptiveLights(among=among):
            return [(("among", *key), message) for key, message in _missing(among, leds, base_from_support)]
        case AllLights() | EveryLight() | LightCone() | Panels() | NoLights():
            return []
        case _:
            assert_never(lights)
    return [
        ((key, i), f"the dome has no {noun} {n}; it has {min(have)} to {max(have)}")
        for i, n in enumerate(numbers)
        if n not in have
    ]


def interleave(boards: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return an order of LEDs [n] in which consecutive LEDs are on different boards: one LED of each board in
    turn."""
    turn = np.zeros(len(boards), np.int64)
    for board in np.unique(boards):
        board_indices = np.flatnonzero(boards == board)
        turn[board_indices] = np.arange(len(board_indices))
    return np.lexsort((boards, turn))

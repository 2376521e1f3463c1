"""What can be wrong with the LEDs of a dome: each fault is found and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from domes import Dome, Noise, dome
from synthesis import Array

from coupole.calibration.leds.boards import boards_of
from coupole.calibration.leds.matching import LedSightings, Matching, fault_lines, match_leds

WELL_SEEN = {"views": 40}


def matched(made: Dome, seen: LedSightings | None = None) -> Matching:
    return match_leds(
        seen or made.seen,
        made.base_from_camera,
        made.prior.lens,
        made.table.ids,
        boards_of(made.table),
        tolerance_px=12.0,
    )


def rewired(made: Dome, lights: dict[int, int]) -> LedSightings:
    """As if LED `a` lit where LED `lights[a]` stands."""
    place = np.array([lights.get(row, row) for row in range(len(made.table.ids))])
    led_at = np.argsort(place)
    frames = made.seen.frames.copy()
    frames[:, 1] = led_at[frames[:, 1]]
    return replace(made.seen, led=led_at[made.seen.led], frames=frames)


def test_a_sound_dome_has_no_faults() -> None:
    assert matched(dome(1, **WELL_SEEN)).faults == ()


def test_a_dead_led_is_named() -> None:
    made = dome(1, **WELL_SEEN)
    found = matched(made, made.seen.only(np.flatnonzero(made.seen.led != 17)))
    assert [(fault.kind, fault.leds) for fault in found.faults] == [("dead", (17,))]
    assert "no spot in any of" in found.faults[0].text


def test_many_dead_leds_are_one_line() -> None:
    made = dome(1, **WELL_SEEN)
    found = matched(made, made.seen.only(np.flatnonzero(made.seen.led >= 6)))
    assert len(found.faults) == 6
    assert fault_lines(found.faults) == ("6 LEDs are dead: no frame shows their spot: 0, 1, 2, 3, 4, 5",)


def test_an_led_that_no_frame_shows_is_not_called_dead() -> None:
    made = dome(1, **WELL_SEEN)
    part = made.seen.only(np.flatnonzero(made.seen.led != 17))
    part = replace(part, frames=part.frames[part.frames[:, 1] != 17])
    assert [fault.kind for fault in matched(made, part).faults] == ["few"]


def test_an_led_that_two_views_see_is_named() -> None:
    made = dome(1, **WELL_SEEN)
    rows = np.flatnonzero(made.seen.led == 20)
    found = matched(made, made.seen.only(np.setdiff1d(np.arange(len(made.seen.led)), rows[2:])))
    assert [(fault.kind, fault.leds) for fault in found.faults] == [("few", (20,))]
    assert "seen in 2 of" in found.faults[0].text


def test_two_swapped_leds_are_named_and_found_at_each_others_place() -> None:
    made = dome(2, **WELL_SEEN)
    found = matched(made, rewired(made, {4: 29, 29: 4}))
    assert [(fault.kind, set(fault.leds)) for fault in found.faults] == [("swapped", {4, 29})]
    assert "on boards 0, 4" in found.faults[0].text
    assert (found.place_of[4], found.place_of[29]) == (29, 4)
    assert np.linalg.norm(found.found_mm[4] - made.true_mm[29]) < 1.0


def test_a_board_wired_in_a_ring_is_named() -> None:
    made = dome(2, **WELL_SEEN)
    found = matched(made, rewired(made, {12: 13, 13: 14, 14: 12}))
    assert [fault.kind for fault in found.faults] == ["miswired"]
    assert "mis-wired on board 2: each of LEDs 12 -> 13 -> 14 -> 12" in found.faults[0].text


def test_two_boards_with_their_plugs_swapped_are_named_led_by_led() -> None:
    made = dome(2, **WELL_SEEN)
    swap = {a: a + 6 for a in range(6)} | {a + 6: a for a in range(6)}
    found = matched(made, rewired(made, swap))
    assert sorted(fault.kind for fault in found.faults) == ["swapped"] * 6


def test_a_board_that_was_mounted_elsewhere_is_not_called_miswired() -> None:
    made = dome(3, **WELL_SEEN)
    along = made.table.positions_mm[13] - made.table.positions_mm[12]
    moved_mm = made.table.positions_mm.copy()
    moved_mm[12:18] -= along  # the table has it one LED farther
    found = matched(replace(made, table=replace(made.table, positions_mm=moved_mm)))
    assert found.faults == ()
    assert (found.place_of == np.arange(len(made.table.ids))).all()


def test_spots_that_contradict_each_other_are_astray() -> None:
    made, random = dome(1, **WELL_SEEN), np.random.default_rng(1)
    rows = np.flatnonzero(made.seen.led == 8)
    made.seen.pixels[rows] = random.uniform(100, 3000, (len(rows), 2))
    found = matched(made)
    assert [(fault.kind, fault.leds) for fault in found.faults] == [("astray", (8,))]


def test_reflections_beside_every_led_change_nothing() -> None:
    made, random = dome(1, **WELL_SEEN), np.random.default_rng(1)
    seen = made.seen
    false = random.uniform(100, 3000, seen.pixels.shape)
    both = LedSightings(
        np.tile(seen.view, 2),
        np.tile(seen.led, 2),
        np.concatenate([seen.pixels, false]),
        np.tile(seen.covariance, (2, 1, 1)),
        seen.frames,
    )
    found = matched(made, both)
    assert found.faults == ()
    assert _farthest(found, made) < 1.0


def test_a_mirror_image_behind_the_support_is_not_taken_for_the_led() -> None:
    made = dome(1, noise=Noise(robot_mm=0.0, robot_deg=0.0, records=0.0), **WELL_SEEN)
    mirrored = made.true_mm * [1, 1, -1] + [0, 0, 2 * 1450.0]
    eyes = made.base_from_camera[made.seen.view]
    there = np.einsum("kji,kj->ki", eyes[:, :3, :3], mirrored[made.seen.led] - eyes[:, :3, 3])
    visible = np.flatnonzero(there[:, 2] > 100)
    extra = made.seen.only(visible)
    pixels = there[visible, :2] / there[visible, 2:] * 7120.0 + [2049.3, 1533.8]
    both = LedSightings(
        np.concatenate([made.seen.view, extra.view]),
        np.concatenate([made.seen.led, extra.led]),
        np.concatenate([made.seen.pixels, pixels]),
        np.concatenate([made.seen.covariance, extra.covariance]),
        made.seen.frames,
    )
    assert _farthest(matched(made, both), made) < 1.0


def _farthest(found: Matching, made: Dome) -> float:
    off: Array = np.linalg.norm(found.found_mm - made.true_mm, axis=1)
    return float(off.max())

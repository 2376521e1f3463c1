"""What the world tells of its last exposures to those who check labels."""

from __future__ import annotations

from pathlib import Path

import cells
from cells import SOME_LIGHTS, CellFolder
from expected_pictures import Expectation

from sim.world.exposure_log import ExposureLog
from sim.world.lighting import Lighting

MS = 1_000_000


def test_an_exposure_is_told_with_all_that_shone_in_it_and_for_how_long() -> None:
    lighting = Lighting()
    lighting.light(4, 10 * MS, 20 * MS)
    lighting.light(9, 20 * MS, 30 * MS)
    log = ExposureLog(lighting, 8)
    log.note(0, 7, 123, 12 * MS, 18 * MS)
    log.note(1, 8, 456, 19 * MS, 22 * MS)
    log.note(2, 9, 789, 31 * MS, 32 * MS)
    told = {number: (*which, exposure_s, dict(lit)) for number, *which, exposure_s, lit, _ in log.since(0, 10)}
    assert told == {
        0: (7, 123, 6e-3, {4: 6e-3}),
        1: (8, 456, 3e-3, {4: 1e-3, 9: 2e-3}),
        2: (9, 789, 1e-3, {}),
    }


def test_exposures_are_told_page_by_page_and_the_oldest_are_forgotten() -> None:
    log = ExposureLog(Lighting(), 5)
    for number in range(8):
        log.note(number, number + 1, number, number * MS, (number + 1) * MS)
    assert [one.number for one in log.since(0, 3)] == [3, 4, 5]
    assert [one.number for one in log.since(6, 3)] == [6, 7]
    assert log.next_number == 8


def test_a_world_that_is_to_remember_nothing_does_not() -> None:
    log = ExposureLog(Lighting(), 0)
    log.note(0, 1, 0, 0, MS)
    assert log.since(0, 10) == []
    assert log.next_number == 1


def test_what_the_world_says_was_lit_is_what_the_pictures_show(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.join()
    cell.write(lights=SOME_LIGHTS)
    with cell.world(exposures_remembered=200) as world:
        assert cell.acquire().code == 0
        told = world.ask("exposures", first=0, count=200)
    lit = {(frame_id, timestamp_ns): shone for _, frame_id, timestamp_ns, _, shone, _ in told["exposures"]}
    assert told["next"] == len(lit) == 66
    shown = 0
    frames = cells.stored(cell.run_folder)
    expectation = Expectation(cell, frames["top/led0400/e0"].base_from_camera)
    for shot, frame in frames.items():
        shone = [led for led, _ in lit[int(frame.record["frame_id"]), int(frame.record["camera_ns"])]]
        if cells.is_light(shot):
            shown += expectation.led_of(frame.pixels) == shone[0]
        else:
            assert shone == []
    assert shown == 54

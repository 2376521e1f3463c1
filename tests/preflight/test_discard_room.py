"""Disk space of runs whose frames are discarded: most that is occupied at a time."""

from __future__ import annotations

import re

from rich.console import Console

from coupole.preflight.discard_room import DiscardRoom, ViewRoom
from coupole.preflight.preflight import Report
from coupole.storage.run import Occupied
from coupole.viewing.preflight_table import show_preflight

VIEW = ViewRoom(frame_bytes=1000, kept_bytes=100, sample_bytes=80)
ROOM = DiscardRoom({"a": VIEW, "b": VIEW, "c": VIEW}, fit_bytes=500, reserve_bytes=7)
ALL = {"a", "b", "c"}


def test_a_new_run_needs_what_all_views_keep_and_one_views_frames() -> None:
    assert ROOM.peak_bytes(Occupied(), ALL) == 3 * 80 + 3 * 100 + 900


def test_fits_count_where_they_are_larger_than_a_views_frames() -> None:
    large_fits = DiscardRoom(ROOM.views, fit_bytes=2000, reserve_bytes=0)
    assert large_fits.peak_bytes(Occupied(), ALL) == 3 * 80 + 3 * 100 + 2000


def test_views_that_are_settled_need_nothing_more() -> None:
    occupied = Occupied({"a": 100, "b": 2000}, frozenset({"a", "b"}))
    assert ROOM.peak_bytes(occupied, {"c"}) == 80 + 100 + 900
    assert ROOM.peak_bytes(Occupied(dict.fromkeys(ALL, 100), frozenset(ALL)), ()) == 500


def test_a_complete_view_that_waits_gives_its_frames_back_after_its_samples() -> None:
    assert ROOM.peak_bytes(Occupied({"a": 1000}), {"b", "c"}) == 3 * 80 + 2 * 100 + (100 - 1000) + 900
    assert ROOM.peak_bytes(Occupied({"a": 1000, "b": 1000, "c": 1000}), ()) == 3 * 80


def test_a_view_that_is_begun_has_its_file_already() -> None:
    assert ROOM.peak_bytes(Occupied({"c": 1000}), {"c"} | {"a", "b"}) == 3 * 80 + 3 * 100 - 1000 + 900


def test_a_view_needs_room_for_itself_and_for_samples_that_are_to_come() -> None:
    assert ROOM.needed_bytes("c", {"a", "b"}) == 1000 + 80 + 2 * 80 + 7


def test_what_stays_is_what_is_kept_of_all_views_with_samples_and_fits() -> None:
    assert ROOM.staying_bytes == 3 * 100 + 3 * 80 + 500


def test_each_size_says_what_it_includes() -> None:
    words = shown(Report(bytes=9_000_000, peak_bytes=5_000_000, staying_bytes=2_000_000))
    assert re.search(r"all frames, added up +9.0 MB", words), words
    at_a_time = "5.0 MB: frames of one view, kept frames of all views, samples and fits"
    assert re.search(rf"on disk at a time, at most +{at_a_time}", words), words
    assert re.search(r"stays on disk, at most +2.0 MB: frames that are not discarded, samples and fits", words)
    assert re.search(r"on disk +9.0 MB", shown(Report(bytes=9_000_000)))


def shown(report: Report) -> str:
    console = Console(width=200, record=True, quiet=False)
    with console.capture() as captured:
        show_preflight(console, report, name="plan", rig="rig")
    return captured.get()

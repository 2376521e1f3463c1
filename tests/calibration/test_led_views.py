"""Which views see all LEDs often enough, and how many images that takes."""

from __future__ import annotations

import numpy as np
from domes import LENS, SIZE_PX, eyes, table

from coupole.calibration.leds.boards import boards_of
from coupole.calibration.leds.views import LedViews, led_views
from coupole.calibration.optics import NAMES, Intrinsics

LENS_KNOWN = Intrinsics(**dict(zip(NAMES, LENS.vector(), strict=True)))


def planned(boards: int = 12, candidates: int = 150) -> LedViews:
    known = table(boards)
    return led_views(boards_of(known), eyes(candidates, known, np.random.default_rng(1)), LENS_KNOWN, SIZE_PX)


def test_each_board_is_lit_in_six_views_and_in_no_more() -> None:
    plan = planned()
    assert plan.few == ()
    assert all(sum(board in view.boards for view in plan.views) == 6 for board in range(12))
    assert plan.images == 12 * 6 * 6


def test_a_view_is_used_once() -> None:
    used = [view.candidate for view in planned().views]
    assert len(set(used)) == len(used)


def test_boards_that_too_few_candidates_see_are_named() -> None:
    assert len(planned(candidates=5).few) > 0


def test_chosen_views_tell_more_than_as_many_taken_at_random() -> None:
    known = table(12)
    boards, candidates = boards_of(known), eyes(150, known, np.random.default_rng(1))
    chosen = led_views(boards, candidates, LENS_KNOWN, SIZE_PX)
    first = led_views(boards, candidates[: len(chosen.views)], LENS_KNOWN, SIZE_PX)
    assert np.median(chosen.u_mm) < np.median(first.u_mm)

"""Pictures of LEDs that were kept for the check."""

from __future__ import annotations

import numpy as np

from coupole.reflectance.run_pictures import CheckFrames


def test_a_view_without_leds_for_the_check_has_no_pairs() -> None:
    none = CheckFrames(
        np.zeros((0, 4, 6, 3), np.float16), np.zeros(0, np.int64), np.zeros(0), np.zeros((3, 4, 6), np.int32)
    )
    place, values = none.pairs(slice(0, 1), 1)
    assert (len(place), values.shape) == (24, (24, 0))

"""The coded marks: where they lie on the grid of the lights' steps."""

from __future__ import annotations

import numpy as np

from coupole.devices import STEP_DTYPE
from coupole.plan.marks import MARK_UNITS, MARKS_AT_ENDS, with_marks

PERIOD_US = 16_000
LIGHTS = 7


def test_no_mark_lies_on_the_grid_of_the_lights_and_no_two_in_the_same_place_beside_it() -> None:
    """A burst that is shifted by whole steps against its frames then fits no mark: by the edges' times alone."""
    steps, dark = np.zeros(LIGHTS, STEP_DTYPE), np.zeros(1, STEP_DTYPE)
    dark["period_us"] = PERIOD_US
    marks = list(range(sum(MARKS_AT_ENDS["coded"])))
    table, _ = with_marks("coded", steps, list(range(LIGHTS)), marks, dark)
    count_start, count_end = MARKS_AT_ENDS["coded"]
    edges_us = np.cumsum([0, *table["period_us"][:-1]])
    first_light_us = edges_us[count_start]
    phases = (edges_us - first_light_us) % PERIOD_US * MARK_UNITS // PERIOD_US
    assert not phases[count_start:-count_end].any(), "lights are on their own grid"
    for ends in (phases[:count_start], phases[-count_end:]):
        assert 0 not in ends
        assert len(set(ends.tolist())) == len(ends)

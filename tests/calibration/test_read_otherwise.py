"""Frames are read as those were that the LEDs' powers come from."""

from __future__ import annotations

import cells
import pytest

from coupole.calibration.earlier import GLARE, READ_WITH, SHAPE_SIGNAL, refuse_read_otherwise
from coupole.calibration.record import read_record
from coupole.errors import InputError

POWERS = cells.REPO / "configs/calibrations/led-power.yaml"


@pytest.mark.parametrize("kind", SHAPE_SIGNAL)
@pytest.mark.parametrize(("made_with", "why"), [(1.0, "was made with a"), (0.0, "was made without a")])
def test_powers_say_with_which_records_they_were_made(kind: str, made_with: float, why: str) -> None:
    record = read_record(POWERS)
    told = {READ_WITH + one: 1.0 for one in SHAPE_SIGNAL} | {READ_WITH + kind: made_with}
    same = record.model_copy(update={"fixed": record.fixed | told})
    as_made = [one for one in SHAPE_SIGNAL if told[READ_WITH + one]]
    refuse_read_otherwise(POWERS, same, as_made)
    otherwise = [one for one in SHAPE_SIGNAL if (one in as_made) != (one == kind)]
    with pytest.raises(InputError, match=f"{why} {kind} record"):
        refuse_read_otherwise(POWERS, same, otherwise)


def test_powers_of_a_tile_with_its_glare_do_not_fit_frames_without_and_the_other_way_round() -> None:
    record = read_record(POWERS)
    told = record.model_copy(update={"fixed": record.fixed | {READ_WITH + one: 1.0 for one in SHAPE_SIGNAL}})
    refuse_read_otherwise(POWERS, told, SHAPE_SIGNAL)
    with pytest.raises(InputError, match="was made without a glare record"):
        refuse_read_otherwise(POWERS, told, [*SHAPE_SIGNAL, GLARE])
    with_glare = told.model_copy(update={"fixed": told.fixed | {READ_WITH + GLARE: 1.0}})
    refuse_read_otherwise(POWERS, with_glare, [*SHAPE_SIGNAL, GLARE])
    with pytest.raises(InputError, match="was made with a glare record"):
        refuse_read_otherwise(POWERS, with_glare, SHAPE_SIGNAL)

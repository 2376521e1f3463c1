"""How an operator sees and sets acceptance limits."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import pytest
from photographed import write_folder

from coupole.calibration.acceptance import Allowed, against_limits, parse_limits, words_of
from coupole.calibration.leds.acceptance import LEDS
from coupole.calibration.lens.acceptance import CAMERA, CHROMATIC, HAND_EYE
from coupole.calibration.record import read_record
from coupole.errors import InputError


def test_a_limit_is_set_by_its_name() -> None:
    assert parse_limits(["ray_px=0.8", "rejected=0.1"], CAMERA) == {"ray_px": 0.8, "rejected": 0.1}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["rays=1"],
            "expected one of pixel_px, bare_field, rejected, clipped, pattern, predicted, ray_px, then =VALUE",
        ),
        (["ray_px=1", "ray_px=2"], "given twice"),
        (["ray_px"], "expected a number greater than 0 after `ray_px=`"),
        (["ray_px=-1"], "greater than 0"),
        (["ray_px=nan"], "greater than 0"),
        (["ray_px=inf"], "greater than 0"),
    ],
)
def test_what_is_no_limit_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_limits(words, CAMERA)
    assert message in str(refused.value)


def test_a_limit_that_was_set_keeps_what_is_usual_beside_it() -> None:
    limits = (Allowed("a_px", "first", 1.0, "px"), Allowed("b_px", "second", 2.0, "px"))
    first, second = against_limits(limits, {"a_px": 3.0}, {"a_px": 2.5, "b_px": 2.5})
    assert (first.is_met, first.limit, first.usual, first.name) == (True, 3.0, 1.0, "a_px")
    assert (second.is_met, second.limit, second.usual) == (False, 2.0, None)


@pytest.mark.parametrize("limits", [CAMERA, HAND_EYE, CHROMATIC, LEDS])
def test_every_limit_of_a_calibration_has_a_name_of_its_own_and_is_in_the_help(
    limits: tuple[Allowed, ...],
) -> None:
    assert len({each.name for each in limits}) == len(limits)
    assert all(f"{each.name}={each.usual:g}" in words_of(limits) for each in limits)


def test_the_command_holds_a_calibration_against_the_operators_limits(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "pictures")
    words = ("calibrate", "camera", folder, "--model", "brown4", "--out", tmp_path, "--json", "--name")
    usual = cells.here(*words, "usual")
    strict = cells.here(*words, "strict", "--limit", "pixel_px=0.0001", "--limit", "ray_px=50")
    assert usual.code in (0, 3)
    assert strict.code == 3
    assert "noise of corners is" in strict.err
    assert "at most 0.0001 is allowed" in strict.err
    by_name = {limit["name"]: limit for limit in json.loads(strict.out)["limits"]}
    assert by_name["ray_px"] | {"found": 0} == {
        "what": "uncertainty at the field's corners", "found": 0, "limit": 50.0, "unit": "px", "name": "ray_px",
        "usual": 0.5, "passed": True,
    }  # fmt: skip
    assert not read_record(tmp_path / "strict.yaml").is_accepted
    assert "<code>ray_px</code>, usually 0.5" in (tmp_path / "strict.html").read_text()

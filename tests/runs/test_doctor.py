"""`coupole doctor`: the machine's answers are measured, and judged without asserting how fast this machine is."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cells
import pytest
from places import REPO

from coupole.commands.doctor import advice_of, words_of
from drivers.kuka.rsi.jitter import jitter_of

RIG = Path("rig.yaml")


def test_it_measures_real_answers_and_says_whether_they_hold() -> None:
    ended = cells.here("doctor", "--seconds", "0.5", "--json")
    told = json.loads(ended.out)
    first = told["measured"][0]
    assert (first["cycle_ms"], first["answers"]) == (4, 125)
    assert 0.0 < first["p50_us"] <= first["p99_us"] <= first["p99_99_us"] <= first["max_us"] <= 4000.0
    assert ended.code == (0 if told["holds"] else 3)
    assert len(told["measured"]) == (1 if told["holds"] else 2)


def test_an_arm_that_is_not_answered_in_cycles_has_nothing_to_measure() -> None:
    ended = cells.here("doctor", "--rig", REPO / "configs/rigs/sim-eki.yaml", "--json")
    told = json.loads(ended.out)
    assert (ended.code, told["holds"], told["measured"]) == (0, None, [])
    assert "nothing to measure" in told["advice"]
    assert {need["part"] for need in told["needs"]} == {"storage"}


def test_what_a_real_cell_lacks_is_told_with_its_remedy_and_refused() -> None:
    rig = REPO / "configs/rigs/la-coupole.yaml"
    ended = cells.here("doctor", "--rig", rig, "--json")
    lacking = {need["name"]: need for need in json.loads(ended.out)["needs"] if not need["is_met"]}
    assert "port: /dev/ttyACM0" in rig.read_text()
    assert ended.code == 3
    assert "by-id" in lacking["serial port /dev/ttyACM0"]["remedy"]
    assert "XIMEA's software package" in lacking["library libm3api.so.2"]["remedy"]
    for need in lacking.values():
        assert need["remedy"] in ended.err or not need["is_vital"]


def test_one_late_answer_of_fifteen_thousand_is_a_cycle_that_does_not_hold() -> None:
    good = jitter_of([100.0] * 14_999 + [3999.0], 4, realtime=True)
    late = jitter_of([100.0] * 14_999 + [math.inf], 4, realtime=True)
    assert (good.holds, late.holds) == (True, False)
    assert late.late_share == pytest.approx(1 / 15_000)
    assert (late.max_us, late.p99_us) == (4000.0, 100.0)


@pytest.mark.parametrize(
    ("at_4", "at_12", "realtime", "expected"),
    [
        (100.0, None, True, "holds a cycle of 4 ms"),
        (math.inf, 100.0, True, "set `cycle_ms: 12`"),
        (math.inf, 100.0, False, "right to real-time priority"),
        (math.inf, math.inf, True, "drivers.kuka.eki:KukaEki"),
    ],
)
def test_the_advice_names_the_cycle_the_right_or_the_other_driver(
    at_4: float, at_12: float | None, realtime: bool, expected: str
) -> None:
    found = [jitter_of([at_4], 4, realtime=realtime)]
    if at_12 is not None:
        found.append(jitter_of([at_12], 12, realtime=realtime))
    assert expected in advice_of(found, RIG)
    assert "real-time priority" in words_of(found[0]) or not realtime

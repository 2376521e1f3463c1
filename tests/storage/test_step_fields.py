"""What a frame table keeps of a step: the file's own terms, and nothing made up."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from coupole.devices import NO_LED, UNKNOWN_NS, StepRecord
from coupole.storage.frame_file import FRAME_DTYPE
from coupole.storage.step_fields import board_temperature_c, step_fields, temperature_range_c

KNOWN = StepRecord(7, 417, True, False, False, False, 9200.0, 10**9, 10**9 + 10**6, 23.4, 700.0)
UNKNOWN = StepRecord(0, 5, False, False, False, False, 9200.0, UNKNOWN_NS, UNKNOWN_NS, math.nan, math.nan)


def records(*steps: StepRecord) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    table = np.zeros(len(steps), FRAME_DTYPE)
    for row, step in enumerate(steps):
        for name, value in step_fields(step, 123).items():
            table[name][row] = value
    return table


def test_what_a_box_logs_is_kept_as_it_was() -> None:
    assert step_fields(KNOWN, KNOWN.t_trigger_ns) == {
        "t_trigger_ns": 1_001_000_000,
        "led": 417,
        "step": 7,
        "board_temperature_dc": 234,
        "led_current_ma": 700,
        "status": 0,
    }


def test_a_frame_without_light_has_led_65535() -> None:
    assert step_fields(dataclasses.replace(KNOWN, led=NO_LED), 0)["led"] == 65535


@pytest.mark.parametrize(
    ("change", "status"),
    [({"led_open": True}, 1), ({"over_temperature": True}, 2), ({"edge_sent": False}, 4), ({"waited": True}, 8)],
)
def test_each_flag_is_a_bit_of_the_status(change: dict[str, bool], status: int) -> None:
    assert step_fields(dataclasses.replace(KNOWN, **change), 0)["status"] == status


def test_what_a_box_cannot_tell_is_read_back_as_unknown() -> None:
    (record,) = records(UNKNOWN)
    assert board_temperature_c(record) is None
    assert (record["led_current_ma"], record["t_trigger_ns"]) == (0, 123)


def test_the_range_of_temperatures_leaves_out_what_is_unknown() -> None:
    warm = dataclasses.replace(KNOWN, board_temperature_c=31.5)
    assert temperature_range_c(records(UNKNOWN, KNOWN, warm, UNKNOWN)) == (23.4, 31.5)
    assert temperature_range_c(records(UNKNOWN)) is None

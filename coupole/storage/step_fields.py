"""Fields of a step's record that a frame table keeps: the columns of a view's file, in the file's units and
codes."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from coupole.devices import NO_LED, StepRecord

STORED_NO_LED = 0xFFFF
"""`led` of a frame without light."""
_LED_OPEN, _OVER_TEMPERATURE, _NO_EDGE, _WAITED = 1, 2, 4, 8
"""Bits of `status`."""
_UNKNOWN = 0
"""Value of `board_temperature_dc` and `led_current_ma` if the box did not measure them."""


def step_fields(record: StepRecord, t_trigger_ns: int) -> dict[str, int]:
    """Return the values of a step for the table of frames. The step was triggered at `t_trigger_ns`."""
    return {
        "t_trigger_ns": t_trigger_ns,
        "led": STORED_NO_LED if record.led == NO_LED else record.led,
        "step": record.step,
        "board_temperature_dc": _whole(10 * record.board_temperature_c),
        "led_current_ma": _whole(record.led_current_ma),
        "status": _LED_OPEN * record.led_open
        | _OVER_TEMPERATURE * record.over_temperature
        | _NO_EDGE * (not record.edge_sent)
        | _WAITED * record.waited,
    }


def board_temperature_c(record: np.void) -> float | None:
    """Return the temperature of the LED's board from a frame's record (FRAME_DTYPE), C; None if the box did not
    measure it."""
    decicelsius = int(record["board_temperature_dc"])
    return None if decicelsius == _UNKNOWN else decicelsius / 10


def temperature_range_c(records: Iterable[np.void]) -> tuple[float, float] | None:
    """Return the lowest and the highest temperature of the boards; None if none is known."""
    temperatures_c = [celsius for record in records if (celsius := board_temperature_c(record)) is not None]
    return (min(temperatures_c), max(temperatures_c)) if temperatures_c else None


def _whole(value: float) -> int:
    return _UNKNOWN if math.isnan(value) else round(value)

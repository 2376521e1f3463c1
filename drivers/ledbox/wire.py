"""Binary records of the SCPI box: 16 bytes per step of a table, 28 bytes per step of a log.

The layout is defined in docs/reference/ledbox-protocol.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED, STEP_DTYPE, STEP_RECORD_DTYPE, UNKNOWN_NS

_NO_LED = 0xFFFF
_NO_EDGE_WANTED = 1
_LED_OPEN, _OVER_TEMPERATURE, _NO_EDGE_SENT, _WAITED = 1, 2, 4, 8

_STEP = np.dtype(
    [
        ("led", "<u2"),
        ("flags", "<u2"),
        ("on_us", "<u4"),
        ("trigger_delay_us", "<u4"),
        ("period_us", "<u4"),
    ]
)
_RECORD = np.dtype(
    [
        ("step", "<u4"),
        ("led", "<u2"),
        ("status", "<u2"),
        ("t_on_ns", "<u8"),
        ("t_trigger_ns", "<u8"),
        ("board_temperature_dc", "<i2"),
        ("led_current_ma", "<u2"),
    ]
)
STEP_BYTES, RECORD_BYTES = _STEP.itemsize, _RECORD.itemsize
_TIMES = ("on_us", "trigger_delay_us", "period_us")


def pack(table: NDArray[np.void]) -> bytes:
    """A table (STEP_DTYPE [n]) as uploaded.

    Raises TypeError for another kind of array, ValueError naming the first record that does not fit the format.
    """
    if table.dtype != STEP_DTYPE or table.ndim != 1:
        raise TypeError(f"a table is one row of STEP_DTYPE records, not {table.dtype} {table.shape}")
    _refuse_beyond(table, "led", NO_LED, _NO_LED - 1)
    for name in _TIMES:
        _refuse_beyond(table, name, 0, 2**32 - 1)
    steps = np.zeros(len(table), _STEP)
    steps["led"] = np.where(table["led"] == NO_LED, _NO_LED, table["led"])
    steps["flags"] = np.where(table["sends_edge"], 0, _NO_EDGE_WANTED)
    for name in _TIMES:
        steps[name] = table[name]
    return steps.tobytes()


def unpack_log(log: bytes, step_table: NDArray[np.void]) -> NDArray[np.void]:
    """Records (STEP_RECORD_DTYPE [k]) of a log received for the started table (STEP_DTYPE [n]).

    Raises ValueError for incomplete records, and for records of steps that the table does not have.
    """
    if len(log) % RECORD_BYTES:
        raise ValueError(f"{len(log)} bytes came, not a multiple of {RECORD_BYTES}")
    raw = np.frombuffer(log, _RECORD)
    if np.any(raw["step"] >= len(step_table)):
        raise ValueError(f"a record of step {raw['step'].max()} came; the table has {len(step_table)} steps")
    records = np.zeros(len(raw), STEP_RECORD_DTYPE)
    status = raw["status"]
    lit = raw["led"] != _NO_LED
    records["step"] = raw["step"]
    records["led"] = np.where(lit, raw["led"].astype(np.int64), NO_LED)
    records["edge_sent"] = (status & _NO_EDGE_SENT) == 0
    records["led_open"] = (status & _LED_OPEN) != 0
    records["over_temperature"] = (status & _OVER_TEMPERATURE) != 0
    records["waited"] = (status & _WAITED) != 0
    records["on_us"] = np.where(lit, step_table["on_us"][raw["step"]], 0)
    records["t_on_ns"] = raw["t_on_ns"]
    records["t_trigger_ns"] = np.where(records["edge_sent"], raw["t_trigger_ns"].astype(np.int64), UNKNOWN_NS)
    records["board_temperature_c"] = raw["board_temperature_dc"] / 10
    records["led_current_ma"] = raw["led_current_ma"]
    return records


def _refuse_beyond(table: NDArray[np.void], name: str, low: int, high: int) -> None:
    beyond = (table[name] < low) | (table[name] > high)
    if beyond.any():
        record = int(np.flatnonzero(beyond)[0])
        raise ValueError(f"record {record}: {name} must be {low} to {high}, not {table[name][record]}")

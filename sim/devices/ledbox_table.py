"""The limits of the box's table, which the firmware checks. A table is accepted or rejected as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.devices.scpi_parser import ScpiError

NO_LIGHT = 0xFFFF
"""The `led` of a dark step."""
FLAG_NO_TRIGGER = 1
"""Bit of `flags`: no trigger edge in this step."""
STEP = np.dtype(
    [
        ("led", "<u2"),
        ("flags", "<u2"),
        ("on_us", "<u4"),
        ("trigger_delay_us", "<u4"),
        ("period_us", "<u4"),
    ]
)
"""One record of the table, 16 bytes as on the wire."""
MAX_RECORDS = 4096
MIN_ON_US, MAX_ON_US = 1_000, 2_000_000
MIN_PERIOD_US = 100
REST_PER_ON = 2
"""An LED that was lit for t must be off for at least REST_PER_ON * t before the table lights it again."""


def read_table(before: NDArray[np.void], payload: bytes, led_count: int, edge_width_us: int) -> NDArray[np.void]:
    """Return the records `before` (STEP [n]) and the records of an uploaded block. Raises ScpiError for a record
    out of limits."""
    if len(payload) % STEP.itemsize:
        raise ScpiError(-161, f"{len(payload)} bytes are not a multiple of {STEP.itemsize}")
    table = np.concatenate([before, np.frombuffer(payload, STEP)])
    if len(table) > MAX_RECORDS:
        raise ScpiError(-222, f"{len(table)} records exceed {MAX_RECORDS}")
    check_table(table, led_count, edge_width_us)
    return table


def check_table(table: NDArray[np.void], led_count: int, edge_width_us: int) -> None:
    """Raise ScpiError -222, which names the first record out of limits and its fault."""
    led, flags = table["led"], table["flags"]
    on_us, delay_us, period_us = (
        table[name].astype(np.int64) for name in ("on_us", "trigger_delay_us", "period_us")
    )
    lit, edge = led != NO_LIGHT, (flags & FLAG_NO_TRIGGER) == 0
    edge_end_us = np.where(edge, delay_us + edge_width_us, 0)
    rules = (
        (lit & (led >= led_count), f"led must be below {led_count}, or {NO_LIGHT} for none", led),
        (flags & ~np.uint16(FLAG_NO_TRIGGER) != 0, "flags has bits without a meaning", flags),
        (
            (lit & (on_us < MIN_ON_US)) | (on_us > MAX_ON_US),
            f"on_us must be {MIN_ON_US} to {MAX_ON_US}",
            on_us,
        ),
        (lit & edge & (delay_us > on_us), "trigger_delay_us must not exceed on_us", delay_us),
        (
            period_us < np.maximum(np.maximum(on_us, edge_end_us), MIN_PERIOD_US),
            f"period_us must cover on_us, the edge's end and {MIN_PERIOD_US}",
            period_us,
        ),
    )
    faults = [
        (int(record), f"{rule}, not {int(values[record])}")
        for wrong, rule, values in rules
        for record in np.flatnonzero(wrong)[:1]
    ]
    if not faults and (hot := _cooling_fault(led, on_us, period_us)):
        faults = [hot]
    if faults:
        record, fault = min(faults)
        raise ScpiError(-222, f"record {record}: {fault}")


def _cooling_fault(
    led: NDArray[np.uint16], on_us: NDArray[np.int64], period_us: NDArray[np.int64]
) -> tuple[int, str] | None:
    """Return the first record that lights an LED before its least off time is over, with the reason."""
    t_on_us = np.cumsum(period_us) - period_us
    order = np.argsort(led, kind="stable")
    before, after = order[:-1], order[1:]
    rest_us = t_on_us[after] - t_on_us[before] - on_us[before]
    hot = (led[before] == led[after]) & (led[after] != NO_LIGHT) & (rest_us < REST_PER_ON * on_us[before])
    if not hot.any():
        return None
    pair = np.flatnonzero(hot)[np.argmin(after[hot])]
    record, earlier = int(after[pair]), int(before[pair])
    return record, (
        f"led {int(led[record])} rests {int(rest_us[pair])} us after record {earlier}, "
        f"{REST_PER_ON * int(on_us[earlier])} us are needed"
    )

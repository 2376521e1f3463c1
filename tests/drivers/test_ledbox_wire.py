"""The SCPI box's records: what is packed is what docs/reference/ledbox-protocol.md says, and comes back."""

from __future__ import annotations

import struct
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.devices import NO_LED, STEP_DTYPE, UNKNOWN_NS, Step, StepRecord
from drivers.ledbox.wire import RECORD_BYTES, STEP_BYTES, pack, unpack_log

u32 = st.integers(0, 2**32 - 1)
steps = st.builds(Step, st.one_of(st.just(NO_LED), st.integers(0, 65534)), u32, u32, u32, st.booleans())
LOG = struct.Struct("<IHHQQhH")


def table_of(*of: Step) -> Any:
    return np.array([astuple(step) for step in of], STEP_DTYPE)


@given(st.lists(steps, max_size=50))
def test_a_table_travels_as_the_protocol_says(given_steps: list[Step]) -> None:
    packed = pack(table_of(*given_steps))
    expected = [
        (0xFFFF if s.led == NO_LED else s.led, 0 if s.sends_edge else 1, s.on_us, s.trigger_delay_us, s.period_us)
        for s in given_steps
    ]
    assert list(struct.iter_unpack("<HHIII", packed)) == expected
    assert len(packed) == STEP_BYTES * len(given_steps) == 16 * len(given_steps)


@pytest.mark.parametrize(
    ("name", "value"),
    [("led", 65535), ("led", -2), ("on_us", -1), ("on_us", 2**32), ("trigger_delay_us", 2**40), ("period_us", -5)],
)
def test_what_does_not_fit_the_wire_is_refused_by_record(name: str, value: int) -> None:
    table = table_of(*[Step(1, 1000, 0, 2000)] * 3)
    table[name][2] = value
    with pytest.raises(ValueError, match=f"record 2: {name} must be"):
        pack(table)


def test_a_table_of_another_layout_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(TypeError, match="STEP_DTYPE"):
        pack(np.zeros(3, "<u4, <u4"))


@given(
    st.integers(0, 4),
    st.integers(0, 2**62),
    st.integers(0, 2**62),
    st.integers(-(2**15), 2**15 - 1),
    st.integers(0, 2**16 - 1),
    st.integers(0, 15),
)
def test_a_log_is_read_as_the_protocol_says(
    step: int, t_on_ns: int, t_edge_ns: int, dc: int, current_ma: int, status: int
) -> None:
    started = table_of(*(Step(NO_LED if k == 3 else k, 1000 + k, 0, 9000) for k in range(5)))
    led = 0xFFFF if step == 3 else step
    log = LOG.pack(step, led, status, t_on_ns, t_edge_ns, dc, current_ma)
    (record,) = unpack_log(log, started)
    edge_sent = not status & 4
    assert StepRecord(*record.tolist()) == StepRecord(
        step=step,
        led=NO_LED if step == 3 else step,
        edge_sent=edge_sent,
        led_open=bool(status & 1),
        over_temperature=bool(status & 2),
        waited=bool(status & 8),
        on_us=0.0 if step == 3 else 1000.0 + step,
        t_on_ns=t_on_ns,
        t_trigger_ns=t_edge_ns if edge_sent else UNKNOWN_NS,
        board_temperature_c=dc / 10,
        led_current_ma=float(current_ma),
    )
    assert len(log) == RECORD_BYTES == 28


@given(st.binary(max_size=200))
def test_a_log_that_is_no_log_is_refused(log: bytes) -> None:
    started = table_of(Step(0, 1000, 0, 2000))
    try:
        records = unpack_log(log, started)
    except ValueError:
        return
    assert len(records) * RECORD_BYTES == len(log)
    assert np.all(records["step"] == 0)

"""What the LED box and its driver make of everything that goes wrong, one fault at a time."""

from __future__ import annotations

import os
import zlib
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ledbox_world import ledbox_world, opened

from coupole.devices import NO_LED
from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused
from coupole.testing.table_box_conformance import run_to_end, table
from drivers.ledbox import wire
from drivers.ledbox.driver import LedBox
from sim.devices import ledbox_firmware
from sim.world.ledbox_alone import LedBoxAlone

OVER_TEMPERATURE = 2
"""In the status of a log record, as on the wire."""


@pytest.fixture
def world(tmp_path: Path) -> Iterator[LedBoxAlone]:
    with ledbox_world(tmp_path) as running:
        yield running


@pytest.fixture
def box(world: LedBoxAlone) -> Iterator[LedBox]:
    with opened(world) as driver:
        yield driver


def send_behind_its_back(world: LedBoxAlone, message: bytes) -> None:
    """Another program writes to the box on the driver's port."""
    port = os.open(world.box.port, os.O_WRONLY | os.O_NOCTTY)
    os.write(port, message)
    os.close(port)
    world.clock.sleep(0.3)


def test_a_dead_led_draws_no_current_and_gives_no_light(box: LedBox, world: LedBoxAlone) -> None:
    world.do(lambda: world.box.dead_leds.add(4))
    steps = table(8)
    box.load(steps)
    box.start(steps)
    records = run_to_end(box, world)
    assert np.flatnonzero(records["led_open"]).tolist() == [4]
    assert records["led_current_ma"][4] == 0
    assert 4 not in [led for led, _, _ in world.lights]


def test_a_dropped_edge_is_logged_and_counted_but_not_sent(box: LedBox, world: LedBoxAlone) -> None:
    world.do(lambda: world.box.drop_edge(2))
    steps = table(5)
    box.load(steps)
    box.start(steps)
    records = run_to_end(box, world)
    assert (records["t_trigger_ns"] > 0).all()
    assert (box.edges(), world.box.edge_count, len(world.edges_ns)) == (5, 5, 4)


def test_a_doubled_edge_is_sent_twice_but_counted_once(box: LedBox, world: LedBoxAlone) -> None:
    world.do(lambda: world.box.double_edge(2, delay_us=4000))
    steps = table(5)
    box.load(steps)
    box.start(steps)
    run_to_end(box, world)
    assert (box.edges(), len(world.edges_ns)) == (5, 6)
    assert world.edges_ns[3] - world.edges_ns[2] == 4_000_000


def test_a_fault_can_wait_for_an_edge(box: LedBox, world: LedBoxAlone) -> None:
    counted: list[int] = []
    world.box.on_edge_counted = counted.append
    steps = table(3)
    box.load(steps)
    box.start(steps)
    run_to_end(box, world)
    assert counted == [0, 1, 2]


def test_a_board_over_temperature_ends_the_burst_in_a_fault(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(100)
    box.load(steps)
    box.start(steps)
    world.clock.sleep(0.2)
    world.do(lambda: world.box.over_temperature(3))
    world.clock.sleep(0.1)
    with pytest.raises(DeviceFault, match="102 Over-temperature; board 3"):
        box.poll_log()
    assert len(world.lights) < 100


def test_the_last_record_before_a_fault_says_over_temperature(tmp_path: Path) -> None:
    with ledbox_world(tmp_path, board_limit_c=22.1) as world, opened(world) as box:
        steps = table(3, on_us=400_000, period_us=400_000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(1.5)
        assert world.box._scpi.receive(b"SEQ:STAT?;IND?\n") == b"FAULT;1\n"
        log = world.box._scpi.receive(b"SEQ:LOG? 0,9\n")
        assert int.from_bytes(log[4 + 6 : 4 + 8], "little") == OVER_TEMPERATURE


def test_a_hot_board_keeps_the_box_from_starting(box: LedBox, world: LedBoxAlone) -> None:
    world.do(lambda: world.box.over_temperature(179))
    steps = table()
    box.load(steps)
    with pytest.raises(DeviceFault, match="102 Over-temperature; board 179 is at"):
        box.start(steps)


def test_the_watchdog_darkens_a_burst_when_the_host_is_silent(world: LedBoxAlone) -> None:
    with opened(world, watchdog_s=1.0) as box:
        steps = table(300)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(2.0)
        assert 90 < len(world.lights) < 110
        with pytest.raises(DeviceFault, match="101 Watchdog expired"):
            box.poll_log()


def test_the_watchdog_darkens_panels_when_the_host_is_silent(world: LedBoxAlone) -> None:
    with opened(world, watchdog_s=1.0) as box:
        box.panel(1, on=True)
        world.clock.sleep(1.5)
        assert world.panels == [(1, True), (1, False)]


def test_the_watchdog_is_fed_by_polls(world: LedBoxAlone) -> None:
    with opened(world, watchdog_s=3.0) as box:
        steps = table(500)
        box.load(steps)
        box.start(steps)
        assert len(run_to_end(box, world)) == 500


def test_the_watchdog_sleeps_while_all_is_dark(world: LedBoxAlone) -> None:
    with opened(world, watchdog_s=1.0) as box:
        world.clock.sleep(3.0)
        assert not box.running()


def test_a_watchdog_fault_lasts_until_the_box_is_opened_anew(world: LedBoxAlone) -> None:
    steps = table(300)
    with opened(world, watchdog_s=1.0) as box:
        box.load(steps)
        box.start(steps)
        world.clock.sleep(2.0)
        box.lights_off()
        with pytest.raises(DeviceRefused, match=r"latched, \*RST ends it"):
            box.start(steps)
    with opened(world) as box:
        box.load(steps)
        box.start(steps)
        assert box.running()


def test_a_muted_box_darkens_by_its_watchdog(world: LedBoxAlone) -> None:
    with opened(world, watchdog_s=1.0) as box:
        steps = table(300)
        box.load(steps)
        box.start(steps)
        world.do(world.box.mute)
        world.clock.sleep(2.0)
        assert len(world.lights) < 110


def test_a_light_cut_short_is_reported_dark(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(1, on_us=2_000_000, period_us=2_000_000)
    box.load(steps)
    box.start(steps)
    world.clock.sleep(0.5)
    box.lights_off()
    assert len(world.darkened_ns) == 1
    assert world.darkened_ns[0] < world.lights[0][2]


def test_a_cable_pulled_in_a_burst_is_a_device_lost(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(50)
    box.load(steps)
    box.start(steps)
    world.do(world.box.unplug)
    with pytest.raises(DeviceLost):
        box.poll_log()


def test_a_burst_that_another_program_aborts_is_not_taken_for_one_that_is_over(
    box: LedBox, world: LedBoxAlone
) -> None:
    steps = table(400, on_us=2000)
    box.load(steps)
    box.start(steps)
    send_behind_its_back(world, b"\nABOR\n")
    with pytest.raises(DeviceFault, match="the burst ended in state ABORTED"):
        run_to_end(box, world)


def test_a_bank_that_changed_is_uploaded_once_more(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(7)
    box.load(steps)
    send_behind_its_back(world, b"SEQ:BANK 0;DATA #10\n")
    box.start(steps)
    assert len(run_to_end(box, world)) == 7


def test_a_bank_that_stays_wrong_is_refused(
    box: LedBox, world: LedBoxAlone, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_memory = SimpleNamespace(crc32=lambda data: zlib.crc32(data) ^ 1)
    monkeypatch.setattr(ledbox_firmware, "zlib", broken_memory)
    steps = table(7)
    box.load(steps)
    with pytest.raises(DeviceRefused, match=r"CRC-32 .* in bank 0.*after two uploads"):
        box.start(steps)


def test_the_running_bank_cannot_be_replaced(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(100)
    box.load(steps)
    box.start(steps)
    send_behind_its_back(world, b"SEQ:BANK 0;DATA #10\n")
    with pytest.raises(DeviceRefused, match="-221 Settings conflict; bank 0 is running"):
        box.poll_log()


def test_a_log_of_another_burst_is_not_taken_for_ours(box: LedBox, world: LedBoxAlone) -> None:
    steps, other = table(30), table(30, led=300)
    box.load(steps)
    box.start(steps)
    payload = wire.pack(other)
    send_behind_its_back(world, b"ABOR;SEQ:BANK 1;DATA #3%d" % len(payload) + payload + b";:INIT\n")
    with pytest.raises(DeviceError, match="the log's record of step"):
        run_to_end(box, world)


def test_an_open_port_cannot_be_opened_twice(box: LedBox, world: LedBoxAlone) -> None:
    with pytest.raises(DeviceLost, match="no other program has it open"), opened(world):
        pass


def test_garbage_on_the_line_does_not_keep_the_driver_out(world: LedBoxAlone) -> None:
    send_behind_its_back(world, b"\x00\xff*IDN?\n#9\nSEQ:DATA #14zz\n*IDN?\n" * 20)
    with opened(world) as box:
        assert box.identify().vendor == "Coupole"


def test_a_late_answer_to_the_first_message_does_not_keep_the_driver_out(world: LedBoxAlone) -> None:
    """It comes in place of the answer to the second."""
    link, held = world.box._link, []
    send = link.send

    def hold_the_first(data: bytes) -> bool:
        held.append(data)
        if len(held) == 1:
            return True
        return bool(send(held[0] + data)) if len(held) == 2 else bool(send(data))

    world.do(lambda: setattr(link, "send", hold_the_first))
    with opened(world) as box:
        assert box.identify().vendor == "Coupole"
    assert len(held) > 2


def test_a_dark_step_is_no_step_of_an_led(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(3)
    steps["led"][1] = NO_LED
    box.load(steps)
    box.start(steps)
    assert run_to_end(box, world)["led_current_ma"].tolist() == [700, 0, 700]


def test_all_errors_of_the_queue_are_told_and_none_is_left_for_the_next_call(
    box: LedBox, world: LedBoxAlone
) -> None:
    send_behind_its_back(world, b"FOO\nOUTP:PAN7 1\nBAR\n")
    with pytest.raises(DeviceRefused, match=r"-113 .*FOO; -114 .*panel 7.*; -113 .*BAR"):
        box.running()
    assert not box.running()


def test_a_queue_that_never_ends_is_given_up(box: LedBox, world: LedBoxAlone) -> None:
    """Else no lights_off would ever come to its end."""

    class Endless(deque[str]):
        def popleft(self) -> str:
            return self[0]

    endless = Endless(['-350,"Queue overflow"'])
    world.do(lambda: setattr(world.box._scpi, "_errors", endless))
    with pytest.raises(DeviceRefused, match="-350"):
        box.running()
    world.do(lambda: setattr(world.box._scpi, "_errors", deque()))

"""Device clear: the box goes dark at once, whatever is on the line, over each of its wires."""

from __future__ import annotations

import os
import select
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ledbox_world import ledbox_world, opened
from test_ledbox import TcpLink, usb_world

from coupole.clock import Deadline, SystemClock
from coupole.errors import DeviceError, DeviceRefused, DeviceTimeout
from coupole.testing.table_box_conformance import run_to_end, table
from coupole.testing.waiting import Call, wait_until
from drivers.ledbox import LedBox, Settings
from drivers.ledbox.link import Cleared
from drivers.ledbox.serial_link import SerialLink
from drivers.ledbox.wire import pack
from sim.world.ledbox_alone import LedBoxAlone

PROMISED_S = 0.1
SLOW = 0.25
"""World time over machine time: a busy machine must not be taken for a slow box."""
LONG_FLASH = table(1, led=900, on_us=2_000_000, period_us=2_000_000)


def dark_after_s(world: LedBoxAlone, lights_off: Callable[[], None]) -> float:
    """World time from the call to the moment at which the light and the panel are off."""
    dark_ns: list[int] = []
    world.box._cables = replace(world.box._cables, on_panel=lambda panel, on, t_ns: dark_ns.append(t_ns))
    called_ns = world.clock.now_ns()
    lights_off()
    assert len(dark_ns) == len(world.darkened_ns) == 1
    return (max(dark_ns[0], world.darkened_ns[0]) - called_ns) / 1e9


def light_up(box: LedBox, world: LedBoxAlone) -> None:
    box.load(LONG_FLASH)
    box.start(LONG_FLASH)
    box.panel(2, on=True)
    wait_until(lambda: bool(world.lights), "light")


def upload_in_the_middle(box: LedBox, world: LedBoxAlone) -> Call:
    """An upload in another thread, a part of which has reached the box."""
    call = Call(lambda: box.load(table(1080, on_us=1000)))
    wait_until(lambda: any(32 <= len(bank) < 1080 for bank in world.box._tables), "an upload in its middle")
    return call


@pytest.mark.parametrize("baud", [9600, 57_600, 115_200, 921_600])
def test_lights_off_overtakes_an_upload_on_a_serial_line(tmp_path: Path, baud: int) -> None:
    speed = SLOW if baud > 9600 else 2 * SLOW
    with (
        ledbox_world(tmp_path, speed=speed, baud=baud) as world,
        opened(world, baud=baud, watchdog_s=0) as box,
    ):
        light_up(box, world)
        upload = upload_in_the_middle(box, world)
        assert dark_after_s(world, box.lights_off) < PROMISED_S
        error = upload.wait()
    assert isinstance(error, DeviceError)
    assert "meanwhile the lights were switched off" in str(error)


@pytest.fixture(params=["serial", "socket", "usbtmc"])
def world(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[LedBoxAlone]:
    made = {
        "serial": lambda: ledbox_world(tmp_path, speed=SLOW),
        "socket": lambda: ledbox_world(tmp_path, link=TcpLink, speed=SLOW),
        "usbtmc": lambda: usb_world(tmp_path, monkeypatch, speed=SLOW),
    }[request.param]
    with made() as running:
        yield running


@pytest.fixture
def box(world: LedBoxAlone) -> Iterator[LedBox]:
    with opened(world, watchdog_s=0) as driver:
        yield driver


def test_lights_off_does_not_wait_for_an_upload_that_hangs(box: LedBox, world: LedBoxAlone) -> None:
    light_up(box, world)
    lost = world.lose_answers(1)
    upload = Call(lambda: box.load(table(1080, on_us=1000)))
    wait_until(lambda: bool(lost), "a block that is not confirmed")
    assert dark_after_s(world, box.lights_off) < PROMISED_S
    assert not isinstance(upload.wait(), DeviceTimeout)


def test_a_device_clear_reaches_a_box_that_waits_for_the_rest_of_a_block(box: LedBox, world: LedBoxAlone) -> None:
    light_up(box, world)
    box._scpi._link.write(b"SEQ:DATA #532000abc", _NoDeadline(), box._scpi._link.clears)
    if not world.box.port.startswith("usbtmc"):  # whose messages arrive whole
        wait_until(lambda: world.box._scpi.inside_block, "the block's first bytes")
    assert dark_after_s(world, box.lights_off) < PROMISED_S
    assert not world.do(lambda: world.box._scpi.inside_block)


def test_after_a_device_clear_the_next_upload_and_burst_are_whole(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(200, on_us=1000, period_us=1000)
    lost = world.lose_answers(1)
    upload = Call(lambda: box.load(steps))
    wait_until(lambda: bool(lost), "a block that is not confirmed")
    box.lights_off()
    assert upload.wait() is not None
    box.load(steps)
    box.start(steps)
    assert run_to_end(box, world)["led"].tolist() == list(range(200))


def test_a_flash_whose_table_is_up_does_not_begin_after_lights_off(
    box: LedBox, world: LedBoxAlone, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = box.load

    def load_and_be_overtaken(table: Any) -> None:
        load(table)
        assert Call(box.lights_off).wait() is None

    monkeypatch.setattr(box, "load", load_and_be_overtaken)
    with pytest.raises(DeviceError, match="meanwhile the lights were switched off"):
        box.flash(5, 2_000_000)
    assert not box.running()
    assert world.lights == []


def test_a_write_to_a_line_that_takes_nothing_more_ends_when_exchanges_are_ended() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    link = SerialLink(os.ttyname(slave), 115_200, SystemClock())
    write = Call(lambda: link.write(bytes(1_000_000), Deadline(SystemClock(), 15.0), link.clears))
    wait_until(lambda: bool(select.select([master], [], [], 0)[0]), "the first bytes")
    link.end_exchanges()
    assert isinstance(write.wait(), Cleared)
    link.close()
    os.close(master)
    os.close(slave)


def test_a_write_that_a_device_clear_overtakes_at_the_last_moment_sends_nothing() -> None:
    """The clear comes when the write has seen that there was none, and that the line takes bytes."""
    master, slave = os.openpty()
    tty.setraw(slave)
    link = SerialLink(os.ttyname(slave), 115_200, SystemClock())

    class Overtaken:
        def __enter__(self) -> None:
            link.clears += 1

        def __exit__(self, *error: object) -> None:
            pass

    link._gate = Overtaken()  # type: ignore[assignment]
    with pytest.raises(Cleared):
        link.write(b"INIT\n", Deadline(SystemClock(), 15.0), link.clears)
    assert not select.select([master], [], [], 0.1)[0]
    link.close()
    os.close(master)
    os.close(slave)


def test_initiate_clear_does_not_wait_for_a_box_that_takes_no_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with usb_world(tmp_path, monkeypatch, speed=SLOW) as world, opened(world, watchdog_s=0) as box:
        light_up(box, world)
        world.box._link.busy = True
        upload = Call(lambda: box.load(table(1080, on_us=1000)))
        wait_until(lambda: bool(world.box._link.refused), "a transfer that is not taken")
        assert dark_after_s(world, box.lights_off) < PROMISED_S
        assert isinstance(upload.wait(), DeviceError)


def test_a_device_clear_keeps_tables_settings_and_the_error_queue(box: LedBox, world: LedBoxAlone) -> None:
    steps = table(7)
    box.load(steps)
    world.do(lambda: world.box._scpi.receive(b"FOO\n"))
    box._scpi.device_clear()
    with pytest.raises(DeviceRefused, match="-113 Undefined header; FOO"):
        box.running()
    assert box._scpi.ask("SEQ:COUN?;:TRIG:OUTP:WIDT?", 2) == ("7", "50")


class _NoDeadline:
    remaining_s, expired = 1.0, False


# -- tables in blocks ---------------------------------------------------------------------------------------


def test_tables_go_up_in_blocks_of_at_most_512_bytes(tmp_path: Path) -> None:
    with ledbox_world(tmp_path) as world, opened(world) as box:
        blocks: list[int] = []
        upload = world.box._upload

        def note(before: Any, payload: bytes) -> None:
            blocks.append(len(payload))
            upload(before, payload)

        world.box._upload = note
        box.load(table(1080, on_us=1000))
    assert max(blocks) == 512
    assert sum(blocks) == 1080 * 16


def test_other_messages_pass_between_the_blocks_of_an_upload(tmp_path: Path) -> None:
    with ledbox_world(tmp_path) as world, opened(world) as box:
        upload = upload_in_the_middle(box, world)
        assert box.board_temperature_c(0) == 22.0
        seen = len(world.box._tables[0])
        assert upload.wait() is None
    assert seen < 1080


@pytest.mark.parametrize("record", [5, 32, 100])
def test_a_record_out_of_limits_is_named_whichever_block_it_is_in(tmp_path: Path, record: int) -> None:
    with ledbox_world(tmp_path) as world, opened(world) as box:
        steps = table(120)
        steps["on_us"][record] = 999
        with pytest.raises(DeviceRefused, match=f"-222.*record {record}: on_us must be"):
            box.load(steps)
        with pytest.raises(DeviceRefused, match="neither bank"):
            box.start(steps)


def test_an_led_lit_again_too_soon_is_refused_across_blocks(tmp_path: Path) -> None:
    with ledbox_world(tmp_path) as world, opened(world) as box:
        steps = table(40)
        steps["led"][32] = steps["led"][31]
        with pytest.raises(DeviceRefused, match="record 32: led 31 rests 2000 us after record 31"):
            box.load(steps)


def test_a_bank_takes_no_more_records_than_it_has_room_for(tmp_path: Path) -> None:
    def send(message: bytes) -> bytes:
        answer: bytes = world.do(lambda: world.box._scpi.receive(message))
        return answer

    dark = pack(table(1, on_us=0))
    dark = b"\xff\xff" + dark[2:]
    with ledbox_world(tmp_path) as world:
        send(b"SEQ:DATA #565520" + 4095 * dark + b"\n")
        assert send(b"SEQ:DATA:APP #216" + dark + b";:SYST:ERR?;:SEQ:COUN?\n") == b'0,"No error";4096\n'
        refused = send(b"SEQ:DATA:APPend #216" + dark + b";:SYST:ERR?;:SEQ:COUN?\n")
    assert refused == b'-222,"Data out of range; 4097 records exceed 4096";4096\n'


def test_the_time_of_an_upload_is_foretold(tmp_path: Path) -> None:
    """On the world's clock: what preflight waits for."""
    with ledbox_world(tmp_path, speed=0.5) as world, opened(world) as box:
        started_ns = world.clock.now_ns()
        box.load(table(320, on_us=1000))
        took_s = (world.clock.now_ns() - started_ns) / 1e9
    assert Settings(port="any").upload_s(320) == pytest.approx(took_s, rel=0.5)


# -- boxes of protocol 1.0 ----------------------------------------------------------------------------------


def test_a_box_without_device_clear_gets_tables_whole_and_says_so(tmp_path: Path) -> None:
    with ledbox_world(tmp_path, protocol="1.0") as world, opened(world) as box:
        assert box.self_test()["device clear"] == "no: the box speaks protocol 1.0"
        steps = table(1080, on_us=1000, period_us=1000)
        box.load(steps)
        box.start(steps)
        assert len(run_to_end(box, world)) == 1080


def test_lights_off_of_a_box_without_device_clear_comes_behind_the_upload(tmp_path: Path) -> None:
    with ledbox_world(tmp_path, protocol="1.0") as world, opened(world, watchdog_s=0) as box:
        light_up(box, world)
        sent = Call(lambda: box.load(table(600, on_us=1000)))
        wait_until(lambda: world.box._scpi.inside_block, "an upload in its middle")
        assert 0.2 < dark_after_s(world, box.lights_off) < 2.0
        assert sent.wait() is None


def test_a_box_with_device_clear_says_so(tmp_path: Path) -> None:
    with ledbox_world(tmp_path) as world, opened(world) as box:
        assert box.self_test()["device clear"] == "yes"

"""The LED box that speaks SCPI: what every box and every table box must do, over each of its wires."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import usb.backend.libusb1
from fake_usb import Backend, UsbLink
from ledbox_world import SPEED, ledbox_world, opened

from coupole.errors import DeviceLost, DeviceRefused
from coupole.testing import LedBoxConformance, TableLedBoxConformance
from coupole.testing.table_box_conformance import run_to_end, table
from drivers.ledbox.driver import LedBox
from sim.world.ledbox_alone import LedBoxAlone
from sim.world.reactor import Reactor


def usb_world(
    folder: Path, monkeypatch: pytest.MonkeyPatch, speed: float = SPEED
) -> AbstractContextManager[LedBoxAlone]:
    """A world whose box hangs on a USB cable that pyusb finds by itself."""

    def plug_in(reactor: Any) -> UsbLink:
        link = UsbLink(reactor)
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: Backend(link))
        return link

    return ledbox_world(folder, link=plug_in, speed=speed)


class TcpLink:
    """A serial server on the network: bytes of one TCP client."""

    def __init__(self, reactor: Reactor) -> None:
        self._reactor = reactor
        self._server = socket.create_server(("127.0.0.1", 0))
        self._client: socket.socket | None = None
        self._received: Callable[[bytes], None] | None = None
        self._on_break: Callable[[], None] | None = None
        self.port = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        reactor.add_reader(self._server, self._accept)

    def listen(self, on_bytes: Callable[[bytes], None], on_break: Callable[[], None] | None = None) -> None:
        self._received, self._on_break = on_bytes, on_break

    def send(self, data: bytes) -> bool:
        if self._client is not None and self._received is not None:
            self._client.sendall(data)
        return True

    def drop_output(self) -> None:
        """Every byte has left with `send`."""

    def mute(self) -> None:
        self._received = self._on_break = None

    def close(self) -> None:
        self._hang_up()
        if self._server.fileno() >= 0:
            self._reactor.remove_reader(self._server)
            self._server.close()

    def _accept(self) -> None:
        self._hang_up()
        self._client, _ = self._server.accept()
        self._reactor.add_reader(self._client, self._read)

    def _read(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(65536)
        except ConnectionError:
            data = b""
        if not data:
            self._hang_up()
        elif self._received is not None:
            self._received(data)

    def _hang_up(self) -> None:
        if self._client is not None:
            self._reactor.remove_reader(self._client)
            self._client.close()
            self._client = None
            if self._on_break is not None:
                self._on_break()


@pytest.fixture(params=["serial", "socket", "usbtmc"])
def world(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[LedBoxAlone]:
    made = {
        "serial": lambda: ledbox_world(tmp_path),
        "socket": lambda: ledbox_world(tmp_path, link=TcpLink),
        "usbtmc": lambda: usb_world(tmp_path, monkeypatch),
    }[request.param]
    with made() as running:
        yield running


@pytest.fixture
def box(world: LedBoxAlone) -> Iterator[LedBox]:
    with opened(world) as driver:
        yield driver


class TestLedBoxOverScpi(LedBoxConformance, TableLedBoxConformance):
    """The contract of boxes that run tables, over each wire; and what this box has beside it."""

    limits = (
        ("led", 1080, "led must be below 1080"),
        ("on_us", 999, "on_us must be 1000 to 2000000"),
        ("trigger_delay_us", 8001, "trigger_delay_us must not exceed on_us"),
        ("period_us", 7999, "period_us must cover"),
    )
    words_of_rest = "record 7: led 6 rests 2000 us after record 6, 16000 us"
    words_of_no_table = "neither bank"
    words_of_silence = "led box: expected an answer to"
    words_of_lost_state = "led box: expected an answer to SEQ:STAT"
    words_of_a_lost_link = "Check the cable"

    def test_it_says_who_it_is(self, box: LedBox) -> None:
        identity = box.identify()
        assert (identity.vendor, identity.serial, identity.simulated) == ("Coupole", "SIM-0001", True)

    def test_it_measures_the_current_of_each_led(self, box: LedBox, world: LedBoxAlone) -> None:
        steps = table(3)
        box.load(steps)
        box.start(steps)
        assert (run_to_end(box, world)["led_current_ma"] == 700).all()

    def test_a_table_out_of_limits_is_refused_by_its_own_number(self, box: LedBox) -> None:
        steps = table()
        steps["led"][5] = 1080
        with pytest.raises(DeviceRefused, match=r"-222.*record 5: led"):
            box.load(steps)

    def test_its_self_test_tells_state_and_temperature(self, box: LedBox) -> None:
        assert box.self_test()["state"] == "IDLE"
        assert box.self_test()["hottest board"] == "22.0 C"

    def test_a_box_with_another_number_of_leds_is_refused(self, world: LedBoxAlone) -> None:
        with pytest.raises(DeviceRefused, match="7 LEDs"), opened(world, led_count=7):
            pass

    def test_a_panel_that_does_not_exist_is_refused(self, box: LedBox) -> None:
        with pytest.raises(DeviceRefused, match="-114"):
            box.panel(5, on=True)

    def test_light_heats_its_board(self, box: LedBox, world: LedBoxAlone) -> None:
        steps = table(1, on_us=2_000_000, period_us=2_000_000)
        box.load(steps)
        box.start(steps)
        run_to_end(box, world)
        assert box.board_temperature_c(0) == pytest.approx(22.6, abs=0.06)
        assert box.board_temperature_c(1) == 22.0

    def test_steps_wait_for_the_camera_to_be_ready(self, world: LedBoxAlone) -> None:
        with opened(world, wait_for_ready=True) as box:
            world.ready = False
            steps = table(2)
            box.load(steps)
            box.start(steps)
            world.clock.sleep(0.5)
            assert world.lights == []
            world.ready = True
            assert run_to_end(box, world)["waited"].tolist() == [True, False]

    def test_lights_off_is_obeyed_after_an_upload_was_cut_off(self, box: LedBox, world: LedBoxAlone) -> None:
        box.panel(1, on=True)
        box._scpi._link.write(b"SEQ:DATA #532000abc", _NoDeadline(), box._scpi._link.clears)
        box.lights_off()
        assert world.panels[-1] == (1, False)

    def test_after_a_crash_in_an_upload_the_box_can_be_opened_again(self, world: LedBoxAlone) -> None:
        with opened(world) as box:
            box._scpi._link.write(b"SEQ:DATA #532000abc", _NoDeadline(), box._scpi._link.clears)
        with opened(world) as box:
            assert not box.running()


class _NoDeadline:
    remaining_s, expired = 1.0, False


def test_a_port_that_does_not_exist_is_a_device_lost(tmp_path: Path) -> None:
    with (
        ledbox_world(tmp_path) as world,
        pytest.raises(DeviceLost, match="nowhere"),
        opened(world, port="/dev/nowhere"),
    ):
        pass

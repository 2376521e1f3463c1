"""What every LED box must do, over each of its wires."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import usb.backend.libusb1
from fake_usb import Backend, UsbLink
from ledbox_world import LedBoxWorld, dark_table, ledbox_world, opened, run_to_end, table

from coupole.devices import NO_LED
from coupole.errors import DeviceLost, DeviceRefused, DeviceTimeout
from drivers.ledbox.driver import LedBox
from sim.world.reactor import Reactor


def usb_world(folder: Path, monkeypatch: pytest.MonkeyPatch) -> AbstractContextManager[LedBoxWorld]:
    """A world whose box hangs on a USB cable that pyusb finds by itself."""

    def plug_in(reactor: Any) -> UsbLink:
        link = UsbLink(reactor)
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: Backend(link))
        return link

    return ledbox_world(folder, link=plug_in)


class TcpLink:
    """A serial server on the network: bytes of one TCP client."""

    def __init__(self, reactor: Reactor) -> None:
        self._reactor = reactor
        self._server = socket.create_server(("127.0.0.1", 0))
        self._client: socket.socket | None = None
        self._received: Callable[[bytes], None] | None = None
        self.port = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        reactor.add_reader(self._server, self._accept)

    def listen(self, received: Callable[[bytes], None]) -> None:
        self._received = received

    def send(self, data: bytes) -> None:
        if self._client is not None and self._received is not None:
            self._client.sendall(data)

    def mute(self) -> None:
        self._received = None

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
        data = self._client.recv(65536)
        if not data:
            self._hang_up()
        elif self._received is not None:
            self._received(data)

    def _hang_up(self) -> None:
        if self._client is not None:
            self._reactor.remove_reader(self._client)
            self._client.close()
            self._client = None


@pytest.fixture(params=["serial", "socket", "usbtmc"])
def world(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[LedBoxWorld]:
    made = {
        "serial": lambda: ledbox_world(tmp_path),
        "socket": lambda: ledbox_world(tmp_path, link=TcpLink),
        "usbtmc": lambda: usb_world(tmp_path, monkeypatch),
    }[request.param]
    with made() as running:
        yield running


@pytest.fixture
def box(world: LedBoxWorld) -> Iterator[LedBox]:
    with opened(world) as driver:
        yield driver


class TestLedBox:
    def test_it_says_who_it_is(self, box: LedBox) -> None:
        identity = box.identify()
        assert (identity.vendor, identity.serial, identity.simulated) == ("Coupole", "SIM-0001", True)

    def test_its_self_test_tells_state_and_temperature(self, box: LedBox) -> None:
        assert box.self_test()["state"] == "IDLE"
        assert box.self_test()["hottest board"] == "22.0 C"

    def test_a_box_with_another_number_of_leds_is_refused(self, world: LedBoxWorld) -> None:
        with pytest.raises(DeviceRefused, match="7 LEDs"), opened(world, led_count=7):
            pass

    def test_a_burst_lights_each_led_and_sends_each_edge(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(20)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert [led for led, _, _ in world.lights] == list(range(20))
        assert records["step"].tolist() == list(range(20))
        assert box.edges() == len(world.edges_ns) == 20
        assert (records["led_current_ma"] == 700).all()

    def test_edges_follow_their_light_by_the_trigger_delay(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(10, delay_us=300)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        logged_us = (records["t_trigger_ns"] - records["t_on_ns"]) / 1e3
        real_us = (np.array(world.edges_ns) - [on for _, on, _ in world.lights]) / 1e3
        assert logged_us == pytest.approx(300, abs=6)
        assert real_us == pytest.approx(300, abs=6)

    def test_dark_steps_light_nothing_but_send_edges(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = dark_table(3)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert (records["led"] == NO_LED).all()
        assert (len(world.lights), len(world.edges_ns)) == (0, 3)

    def test_steps_without_trigger_send_no_edge(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(3)
        steps["sends_edge"] = False
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert not records["edge_sent"].any()
        assert (world.edges_ns, box.edges()) == ([], 0)

    def test_a_burst_drifts_by_less_than_a_thousandth(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(200, on_us=4000, period_us=5000)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        t_on_ns = records["t_on_ns"].astype(np.int64)
        assert t_on_ns - t_on_ns[0] == pytest.approx(np.arange(200) * 5e6, rel=1e-3, abs=1)
        assert np.diff(world.edges_ns).sum() == pytest.approx(199 * 5e6, rel=1e-3)

    def test_the_next_table_is_uploaded_while_one_runs(self, box: LedBox, world: LedBoxWorld) -> None:
        first, second = table(100), table(30, led=500)
        box.load(first)
        box.start(first)
        box.load(second)
        assert box.running()
        assert len(run_to_end(box, world)) == 100
        box.start(second)
        assert run_to_end(box, world)["led"].tolist() == list(range(500, 530))

    def test_a_table_that_is_there_already_is_not_sent_again(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(1080)
        box.load(steps)
        world.do(world.box.unplug)
        box.load(steps)  # would raise DeviceLost if it had to be sent

    @pytest.mark.parametrize(
        ("field", "value", "words"),
        [
            ("led", 1080, "led must be below 1080"),
            ("on_us", 999, "on_us must be 1000 to 2000000"),
            ("trigger_delay_us", 8001, "trigger_delay_us must not exceed on_us"),
            ("period_us", 7999, "period_us must cover"),
        ],
    )
    def test_a_table_out_of_limits_is_refused_by_record(
        self, box: LedBox, field: str, value: int, words: str
    ) -> None:
        steps = table()
        steps[field][5] = value
        with pytest.raises(DeviceRefused, match=f"-222.*record 5: {words}"):
            box.load(steps)

    def test_an_led_lit_again_too_soon_is_refused(self, box: LedBox) -> None:
        steps = table()
        steps["led"][7] = steps["led"][6]
        with pytest.raises(DeviceRefused, match="record 7: led 6 rests 2000 us after record 6, 16000 us"):
            box.load(steps)

    def test_a_table_never_loaded_does_not_start(self, box: LedBox) -> None:
        with pytest.raises(DeviceRefused, match="neither bank"):
            box.start(table())

    def test_a_long_log_comes_whole(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(150, on_us=1000, period_us=2000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(1.0)
        assert box.poll_log()["step"].tolist() == list(range(150))

    def test_lights_off_ends_a_burst_at_once(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(100, on_us=90_000, period_us=100_000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(0.55)
        box.lights_off()
        assert not box.running()
        lit = len(world.lights)
        world.clock.sleep(0.5)
        assert len(world.lights) == lit < 100

    def test_after_lights_off_another_burst_runs(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(100)
        box.load(steps)
        box.start(steps)
        box.lights_off()
        box.start(steps)
        assert len(run_to_end(box, world)) == 100

    def test_panels_shine_until_lights_off(self, box: LedBox, world: LedBoxWorld) -> None:
        box.panel(3, on=True)
        box.lights_off()
        assert world.panels == [(3, True), (3, False)]

    def test_a_panel_that_does_not_exist_is_refused(self, box: LedBox) -> None:
        with pytest.raises(DeviceRefused, match="-114"):
            box.panel(5, on=True)

    def test_light_heats_its_board(self, box: LedBox, world: LedBoxWorld) -> None:
        steps = table(1, on_us=2_000_000, period_us=2_000_000)
        box.load(steps)
        box.start(steps)
        run_to_end(box, world)
        assert box.board_temperature_c(0) == pytest.approx(22.6, abs=0.06)
        assert box.board_temperature_c(1) == 22.0

    def test_steps_wait_for_the_camera_to_be_ready(self, world: LedBoxWorld) -> None:
        with opened(world, wait_for_ready=True) as box:
            world.ready = False
            steps = table(2)
            box.load(steps)
            box.start(steps)
            world.clock.sleep(0.5)
            assert world.lights == []
            world.ready = True
            assert run_to_end(box, world)["waited"].tolist() == [True, False]

    def test_a_mute_box_times_out(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        with pytest.raises(DeviceTimeout, match="led box: expected an answer to SEQ:STAT"):
            box.running()

    def test_lights_off_of_a_mute_box_is_bounded(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        start_ns = world.clock.now_ns()
        with pytest.raises(DeviceTimeout):
            box.lights_off()
        assert world.clock.now_ns() - start_ns < 30e9

    def test_an_upload_to_a_mute_box_times_out(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        with pytest.raises(DeviceTimeout):
            box.load(table(1080))

    def test_a_cable_pulled_is_a_device_lost(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.unplug)
        with pytest.raises(DeviceLost, match="Check the cable"):
            box.running()

    def test_lights_off_is_obeyed_after_an_upload_was_cut_off(self, box: LedBox, world: LedBoxWorld) -> None:
        box.panel(1, on=True)
        box._scpi._link.write(b"SEQ:DATA #532000abc", _NoDeadline())
        box.lights_off()
        assert world.panels[-1] == (1, False)

    def test_after_a_crash_in_an_upload_the_box_can_be_opened_again(self, world: LedBoxWorld) -> None:
        with opened(world) as box:
            box._scpi._link.write(b"SEQ:DATA #532000abc", _NoDeadline())
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

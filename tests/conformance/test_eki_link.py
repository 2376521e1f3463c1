"""The connection between the EthernetKRL driver and its controller: silence, loss, strangers, frozen clients."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from ipaddress import IPv4Address
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from beside import beside
from eki_cell import EkiCell
from pydantic import ValidationError

from coupole import supervision
from coupole.errors import DeviceFault, DeviceLost, DeviceTimeout
from coupole.testing.robot_conformance import AWAY_DEG
from drivers.kuka.eki import link
from drivers.kuka.eki.driver import KukaEki, Settings


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[EkiCell]:
    with closing(EkiCell(tmp_path)) as cell:
        yield cell


@pytest.fixture
def robot(cell: EkiCell) -> KukaEki:
    return cell.open()


def test_news_of_the_arm_is_as_old_as_the_last_status(cell: EkiCell, robot: KukaEki) -> None:
    before_ns = robot.measured().t_ns
    cell.wait_until(lambda: robot.measured().t_ns > before_ns)
    cell.in_world(lambda: cell.controller.lose_link(1e6))
    cell.wait_until(lambda: robot.measured().t_ns < cell.clock.now_ns() - 1_000_000_000)
    last_ns = robot.measured().t_ns
    cell.clock.sleep(0.5)
    assert robot.measured().t_ns == last_ns
    cell.wait_until(lambda: robot._watch.link_lost)
    with pytest.raises(DeviceLost, match="no status for"):
        robot.measured()


def test_a_world_in_a_hurry_does_not_run_ahead_of_its_client(tmp_path: Path) -> None:
    with closing(EkiCell(tmp_path, speed=1000.0)) as cell:
        robot = cell.open()
        for _ in range(50):
            cell.clock.sleep(0.5)
            status = robot._watch.status
            assert status is not None
            assert cell.clock.now_ns() / 1e6 - status.time_ms < 1000.0


def test_a_client_that_stops_reading_does_not_hold_the_world_and_gets_whole_statuses_afterwards(
    tmp_path: Path,
) -> None:
    """As one that is frozen."""
    cell = EkiCell(tmp_path, speed=200.0, write_limit_s=0.2)
    host, port = cell.settings.address.rsplit(":", 1)
    with closing(cell), socket.create_connection((host, int(port))) as client:
        cell.wait_until(lambda: cell.controller._left_behind)
        cell.clock.sleep(100.0)
        assert cell.controller._left_behind
        client.settimeout(0.5)
        text = b""
        left_at_s = cell.clock.now_ns() / 1e9
        while b'Time="' not in text or int(text.rpartition(b'Time="')[2].partition(b'"')[0]) < 1e3 * left_at_s:
            text += client.recv(65536)
    whole = text[: text.rindex(b"</Coupole>")] + b"</Coupole>"
    times_ms = [int(one.find("Status").attrib["Time"]) for one in ElementTree.fromstring(b"<s>" + whole + b"</s>")]
    assert max(b - a for a, b in pairwise(times_ms)) > 90_000


def test_a_process_that_was_frozen_does_not_take_the_time_for_the_controllers_silence(
    cell: EkiCell, robot: KukaEki, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After it Python's `select` says that nothing came in time, without another look."""
    froze, shift_s = threading.Event(), [0.0]

    def select_when_frozen(*arguments: Any) -> Any:
        if threading.current_thread() is robot._link._thread and not froze.is_set():
            shift_s[0] += 10.0
            froze.set()
            return [], [], []
        return select.select(*arguments)

    clock = SimpleNamespace(
        monotonic=lambda: time.monotonic() + shift_s[0],
        monotonic_ns=lambda: time.monotonic_ns() + int(shift_s[0] * 1e9),
    )
    monkeypatch.setattr(supervision, "time", clock)
    monkeypatch.setattr(link, "time", clock)
    monkeypatch.setattr(link, "select", SimpleNamespace(select=select_when_frozen))
    assert froze.wait(10.0)
    before_ns = robot.measured().t_ns
    cell.wait_until(lambda: robot.measured().t_ns > before_ns)
    assert not robot._watch.link_lost


def test_a_silent_link_is_a_fault_though_the_connection_stays_open(cell: EkiCell, robot: KukaEki) -> None:
    cell.in_world(lambda: cell.controller.lose_link(1e6))
    with pytest.raises(DeviceLost, match="no status for"):
        robot.wait_settled()
    with pytest.raises(DeviceLost, match="no status for"):
        robot.measured()


def test_a_link_lost_in_mid_motion_brakes_the_arm(cell: EkiCell) -> None:
    robot = cell.open(speed_fraction=0.1)
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(lambda: cell.controller.lose_link(1e6))
    cell.clock.sleep(1.5)
    cell.assert_stands()
    assert np.max(np.abs(cell.joints_deg() - AWAY_DEG)) > 1.0
    cell.assert_smooth()


def test_a_second_driver_is_turned_away_and_the_first_goes_on(cell: EkiCell, robot: KukaEki) -> None:
    with pytest.raises(DeviceLost):
        cell.open()
    robot.move_to(AWAY_DEG)
    assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_without_a_controller_opening_fails(cell: EkiCell) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        nobody = f"127.0.0.1:{probe.getsockname()[1]}"
    with pytest.raises(DeviceLost, match="refused"):
        cell.open(address=nobody, connect_timeout_s=0.2)


def test_a_controller_that_never_connects_is_told(cell: EkiCell) -> None:
    with pytest.raises(DeviceLost, match="EthernetKRL"):
        cell.open(address="127.0.0.1:0", controller_is="client", connect_timeout_s=0.2)


def test_a_server_that_says_nothing_is_no_controller(cell: EkiCell) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(DeviceTimeout, match="0 statuses answered"):
            cell.open(address=address, connect_timeout_s=0.2)


def test_a_link_lost_after_an_emergency_stop_is_noticed_too(cell: EkiCell, robot: KukaEki) -> None:
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault, match="emergency stop"):
        robot.wait_settled()
    cell.in_world(lambda: cell.controller.lose_link(1.0))
    cell.wait_until(lambda: robot._watch.link_lost)
    with pytest.raises(DeviceFault, match="emergency stop"):
        robot.measured()
    robot.stop()


def knock(host: str, port: int, over: threading.Event) -> None:
    """Connect from 127.0.0.3 again and again."""
    while not over.wait(0.02):
        with contextlib.suppress(OSError), socket.create_connection((host, port), 1.0, ("127.0.0.3", 0)) as link:
            link.settimeout(1.0)
            link.recv(1)


@contextmanager
def a_stranger_knocks(address: str) -> Iterator[None]:
    host, port = address.rsplit(":", 1)
    with beside(partial(knock, host, int(port))):
        yield


def test_a_controller_named_in_the_rig_is_the_only_client_let_in(tmp_path: Path) -> None:
    with closing(EkiCell(tmp_path, controller_is="client")) as cell:
        with a_stranger_knocks(cell.settings.address), pytest.raises(DeviceLost) as raised:
            cell.open(controller=IPv4Address("127.0.0.2"), connect_timeout_s=0.5)
        assert "connections from other addresses than 127.0.0.2 were turned away" in raised.value.happened
        with a_stranger_knocks(cell.settings.address):
            robot = cell.open(controller=IPv4Address("127.0.0.1"))
        robot.move_to(AWAY_DEG)
        assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_a_controller_that_is_the_server_is_named_by_its_address_alone() -> None:
    with pytest.raises(ValidationError, match="a server is reached at `address`"):
        Settings.model_validate({"arm_model": KR10_R1100_SIXX, "controller": "127.0.0.1"})

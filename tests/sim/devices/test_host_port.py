"""Two simulated arms never send to one host."""

from __future__ import annotations

import errno
import socket
from contextlib import ExitStack, closing

import pytest

from sim.devices import host_port
from sim.devices.host_port import HostPort

PORTS = range(31_990, 31_993)


def test_no_two_worlds_are_given_one_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_port, "_PORTS", PORTS)
    with ExitStack() as stack:
        ports = [stack.enter_context(closing(HostPort("127.0.0.1:0"))) for _ in PORTS]
        assert {port.address for port in ports} == {f"127.0.0.1:{number}" for number in PORTS}


def test_a_port_that_another_program_has_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_port, "_PORTS", PORTS[:2])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", PORTS[0]))
        with closing(HostPort("127.0.0.1:0")) as port:
            assert port.address == f"127.0.0.1:{PORTS[1]}"


def test_a_port_by_name_is_one_worlds_until_it_is_closed() -> None:
    address = f"127.0.0.1:{PORTS[0]}"
    with closing(HostPort(address)), pytest.raises(OSError, match="another simulated cell") as refused:
        HostPort(address)
    assert refused.value.errno == errno.EADDRINUSE
    HostPort(address).close()

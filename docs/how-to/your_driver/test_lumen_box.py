"""The other end of that box's wire, and Coupole's conformance class run on the driver."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from pathlib import Path

import pytest
from lumen_box import ANSWER, REQUEST, LumenBox, Settings

from coupole.testing import LedBoxConformance
from sim.world.ledbox_alone import LedBoxAlone, ledbox_alone


class LumenStandIn:
    """The box's firmware, on the event loop of a simulated world: it has no threads, and tells the world of its
    light."""

    def __init__(self, world: LedBoxAlone) -> None:
        self._world = world
        self.dead_leds: set[int] = set()
        self._deaf_until_ns = 0.0
        self._data = b""
        self._client: socket.socket | None = None
        self._server = socket.create_server(("127.0.0.1", 0))
        self.tcp_port: int = self._server.getsockname()[1]
        world.reactor.add_reader(self._server, self._accept)

    def mute(self, seconds: float | None = None) -> None:
        now_ns = self._world.reactor.now_ns
        self._deaf_until_ns = float("inf") if seconds is None else now_ns + seconds * 1e9

    def unplug(self) -> None:
        self._hang_up()
        if self._server.fileno() >= 0:
            self._world.reactor.remove_reader(self._server)
            self._server.close()

    def close(self) -> None:
        self.unplug()

    def send(self, data: bytes) -> bool:
        if self._client is not None:
            self._client.sendall(data)
        return self._client is not None

    def _accept(self) -> None:
        self._hang_up()
        self._client, _ = self._server.accept()
        self._world.reactor.add_reader(self._client, self._receive)

    def _hang_up(self) -> None:
        if self._client is not None:
            self._world.reactor.remove_reader(self._client)
            self._client.close()
            self._client, self._data = None, b""

    def _receive(self) -> None:
        assert self._client is not None
        piece = self._client.recv(4096)
        if not piece:
            self._hang_up()
        elif self._world.reactor.now_ns >= self._deaf_until_ns:
            self._data += piece
            while len(self._data) >= REQUEST.size:
                number, what, led, on_us = REQUEST.unpack_from(self._data)
                self._data = self._data[REQUEST.size :]
                self._obey(number, what, led, on_us)

    def _obey(self, number: int, what: bytes, led: int, on_us: int) -> None:
        now_ns = self._world.reactor.now_ns
        verdict, words = b"+", b""
        if what == b"?":
            words = b"Lumen 16,SIM-7,1.0"
        elif what == b"D" or (what == b"L" and led < 16):
            self._world.dark(now_ns)
            if what == b"L" and led not in self.dead_leds:
                self._world.light(led, now_ns, now_ns + on_us * 1000)
        else:
            verdict, words = b"-", b"what?"
        self.send(ANSWER.pack(number, verdict, words))


def opened(world: LedBoxAlone) -> AbstractContextManager[LumenBox]:
    """The driver on the stand-in; it runs by the world's clock, as it would in a run."""
    return closing(LumenBox(Settings(host="127.0.0.1", tcp_port=world.box.tcp_port), world.clock))


def stand_in(world: LedBoxAlone) -> tuple[LumenStandIn, LumenStandIn]:
    """The stand-in, and what carries its answers: itself."""
    box = LumenStandIn(world)
    return box, box


@pytest.fixture
def world(tmp_path: Path) -> Iterator[LedBoxAlone]:
    with ledbox_alone(tmp_path, stand_in, opened) as world:
        yield world


@pytest.fixture
def box(world: LedBoxAlone) -> Iterator[LumenBox]:
    with world.opener() as box:
        yield box


class TestLumenBox(LedBoxConformance):
    """Whatever an LED box must do."""

"""TCP ports of a stand-in, on the reactor; connections can be muted to simulate a cut network."""

from __future__ import annotations

import socket
from collections.abc import Callable

from sim.world.reactor import Reactor

_MOST_BYTES = 2**20
"""Largest unfinished input of a client. A client with more is disconnected."""


class Connection:
    """One client's connection: received bytes that are not yet processed, and a way to answer."""

    def __init__(self, link: socket.socket) -> None:
        self.inbox = bytearray()
        self.link = link
        self.gone = False
        """True if the client has left, or accepts no more bytes."""

    def send(self, data: bytes) -> None:
        if self.gone:
            return
        try:
            self.gone = self.link.send(data) < len(data)  # a client that does not read is disconnected
        except OSError:
            self.gone = True


class TcpPort:
    """Listens on one port; `on_open` and `on_bytes` are called on the reactor's thread."""

    def __init__(
        self,
        reactor: Reactor,
        address: tuple[str, int],
        on_open: Callable[[Connection], None],
        on_bytes: Callable[[Connection], None],
    ) -> None:
        self._reactor, self._on_open, self._on_bytes = reactor, on_open, on_bytes
        self._connections: list[Connection] = []
        self._muted: list[Connection] = []
        self._listener = socket.create_server(address)
        self._listener.setblocking(False)
        self._listens = True
        reactor.add_reader(self._listener, self._accept)

    def mute(self) -> None:
        """Answer no client from now on. Connections that exist at that time never recover, and get no message that
        they are lost."""
        if self._listens:
            self._reactor.remove_reader(self._listener)
            self._listens = False
        for connection in self._connections:
            self._reactor.remove_reader(connection.link)
            connection.gone = True
        self._muted += self._connections
        self._connections = []

    def unmute(self) -> None:
        """Answer new clients again, including those that connected meanwhile."""
        if not self._listens:
            self._reactor.add_reader(self._listener, self._accept)
            self._listens = True

    def drop(self) -> None:
        """Close all connections, as a restarting controller does."""
        for connection in self._connections:
            self._end(connection)
        self._connections = []

    def close(self) -> None:
        """Close all sockets. The reactor must not run any more."""
        for connection in (*self._connections, *self._muted):
            connection.link.close()
        self._listener.close()

    def _accept(self) -> None:
        try:
            link, _ = self._listener.accept()
        except OSError:  # it has left already
            return
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = Connection(link)
        self._connections.append(connection)
        self._reactor.add_reader(link, lambda: self._receive(connection))
        self._on_open(connection)

    def _receive(self, connection: Connection) -> None:
        if connection not in self._connections:
            return  # muted or closed by a callback of the same round
        try:
            data = connection.link.recv(65536)
        except OSError:
            data = b""
        connection.inbox += data
        if len(connection.inbox) > _MOST_BYTES:
            connection.gone = True  # no program and no packet is that long
        if data and not connection.gone:
            self._on_bytes(connection)
        if not data or connection.gone:
            self._connections.remove(connection)
            self._end(connection)

    def _end(self, connection: Connection) -> None:
        connection.gone = True
        self._reactor.remove_reader(connection.link)
        connection.link.close()

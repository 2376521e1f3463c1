"""TCP ports of a stand-in, on the reactor: connections that can be muted as a cut network would."""

from __future__ import annotations

import socket
from collections.abc import Callable

from sim.world.reactor import Reactor


class Connection:
    """One client's connection: what it sent and was not yet taken, and a way to answer."""

    def __init__(self, link: socket.socket) -> None:
        self.inbox = bytearray()
        self.link = link
        self.gone = False
        """The client left, or takes no more bytes."""

    def send(self, data: bytes) -> None:
        if self.gone:
            return
        try:
            self.gone = self.link.send(data) < len(data)  # a client that does not read is cut off
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
        """From now on nobody is answered; who is connected now never again, and does not learn it."""
        if self._listens:
            self._reactor.remove_reader(self._listener)
            self._listens = False
        for connection in self._connections:
            self._reactor.remove_reader(connection.link)
            connection.gone = True
        self._muted += self._connections
        self._connections = []

    def unmute(self) -> None:
        """Clients that come, or came meanwhile, are answered again."""
        if not self._listens:
            self._reactor.add_reader(self._listener, self._accept)
            self._listens = True

    def drop(self) -> None:
        """End all connections, as a controller does that restarts."""
        for connection in self._connections:
            self._end(connection)
        self._connections = []

    def close(self) -> None:
        """The reactor has ended or ends: close all sockets."""
        for connection in (*self._connections, *self._muted):
            connection.link.close()
        self._listener.close()

    def _accept(self) -> None:
        link, _ = self._listener.accept()
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = Connection(link)
        self._connections.append(connection)
        self._reactor.add_reader(link, lambda: self._read(connection))
        self._on_open(connection)

    def _read(self, connection: Connection) -> None:
        if connection not in self._connections:
            return  # muted or ended by a callback of the same round
        try:
            data = connection.link.recv(65536)
        except OSError:
            data = b""
        connection.inbox += data
        if data and not connection.gone:
            self._on_bytes(connection)
        if not data or connection.gone:
            self._connections.remove(connection)
            self._end(connection)

    def _end(self, connection: Connection) -> None:
        connection.gone = True
        self._reactor.remove_reader(connection.link)
        connection.link.close()

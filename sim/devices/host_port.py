"""The UDP port on which a simulated KUKA controller looks for its host."""

from __future__ import annotations

import errno
import secrets
import socket

_PORTS = range(20_000, 32_000)
"""Ports below those that the system assigns by itself. So no program gets one by chance before the driver binds
it."""


class HostPort:
    """An address to which the arm of one world only sends, until it is closed or its process ends.

    The host binds the port itself, so no world can bind it. If two arms sent to one port, both would reach the
    same host. The host would move the arm whose packet comes first, but the camera would be on the arm of the
    host's own world. So the port is claimed by the name of a socket (unix(7), abstract), which the kernel gives to
    only one process at a time.
    """

    def __init__(self, address: str) -> None:
        """`host:port`; port 0 means a free one. Raises OSError (EADDRINUSE) if another world has this port."""
        self._host, port = address.rsplit(":", 1)
        while not (claim := self._claim(int(port) or secrets.choice(_PORTS), probe=port == "0")):
            if port != "0":
                raise OSError(errno.EADDRINUSE, "the arm of another simulated cell sends to this port", address)
        self._socket, self._port = claim

    @property
    def address(self) -> str:
        return f"{self._host}:{self._port}"

    def close(self) -> None:
        self._socket.close()

    def _claim(self, port: int, *, probe: bool) -> tuple[socket.socket, int] | None:
        """Claim the port. Return None if another world has the port, or, with `probe`, if any other program has
        it."""
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0coupole-arm-sends-to-{port}")
            if probe:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
                    udp.bind((self._host, port))
        except OSError as error:
            claim.close()
            if error.errno != errno.EADDRINUSE:
                raise
            return None
        return claim, port

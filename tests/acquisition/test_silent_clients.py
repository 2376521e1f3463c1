"""Clients of a run's socket that send nothing or read nothing hold up neither the others nor the end."""

from __future__ import annotations

import json
import socket
from contextlib import ExitStack
from pathlib import Path

from coupole.acquisition.user_socket import UserSocket, exchange

MUCH = 8 * 1024**2
"""More than a socket holds for a client that does not read."""


def test_clients_that_send_or_read_nothing_hold_up_no_other_and_not_the_end(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with ExitStack() as silent:
        with UserSocket(path, lambda asked, _: {"asked": asked.decode(), "much": "x" * MUCH}):
            for request in [b"", b'"part', b'"state"\n'] * 4:  # fewer than the socket's backlog
                client = silent.enter_context(socket.socket(socket.AF_UNIX))
                client.settimeout(30)
                client.connect(str(path))
                client.sendall(request)
            found = exchange(path, {"ask": "state"}, patience_s=30)
            assert (json.loads(found["asked"]), len(found["much"])) == ({"ask": "state"}, MUCH)
        assert not path.exists()  # while all of them are still there

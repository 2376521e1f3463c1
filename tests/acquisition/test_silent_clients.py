"""Clients of a run's socket that send nothing or read nothing hold up neither the others nor the end."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from coupole.acquisition.user_socket import UserSocket, exchange

MUCH = 8 * 1024**2
"""More than a socket holds for a client that does not read."""


def test_clients_that_send_or_read_nothing_hold_up_no_other_and_not_the_end(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with ExitStack() as silent:
        with UserSocket(path, lambda asked, _: {"asked": asked.decode(), "much": "x" * MUCH}):
            for request in [b"", b'"part', b'"state"\n'] * 4:
                client = silent.enter_context(socket.socket(socket.AF_UNIX))
                client.settimeout(30)
                client.connect(str(path))
                client.sendall(request)
            found = exchange(path, {"ask": "state"}, patience_s=30)
            assert (json.loads(found["asked"]), len(found["much"])) == ({"ask": "state"}, MUCH)
        assert not path.exists()  # while all of them are still there


@contextmanager
def full_queue(path: Path) -> Iterator[socket.socket]:
    """A socket whose process accepts nobody, and for which as many wait as may."""
    with ExitStack() as waiting:
        stopped = waiting.enter_context(socket.socket(socket.AF_UNIX))
        stopped.bind(str(path))
        stopped.listen(1)
        for _ in range(2):
            waiting.enter_context(socket.socket(socket.AF_UNIX)).connect(str(path))
        yield stopped


def test_a_process_that_accepts_nobody_is_told_as_such(tmp_path: Path) -> None:
    """As one that is stopped, and that many have asked already."""
    path = tmp_path / "socket"
    message = r"accepts no connection.*`kill -CONT PID` lets a process run again"
    with full_queue(path), pytest.raises(TimeoutError, match=message):
        exchange(path, {"ask": "state"}, patience_s=0.2)


def test_a_place_that_becomes_free_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with full_queue(path) as stopped, ExitStack() as taken:

        def go_on() -> None:
            for _ in range(3):
                connection, _ = stopped.accept()
                taken.enter_context(connection)
            connection.makefile().readline()
            connection.sendall(b'{"state": "running"}\n')

        answering = threading.Timer(0.3, go_on)
        answering.start()
        assert exchange(path, {"ask": "state"}, patience_s=30) == {"state": "running"}
        answering.join()

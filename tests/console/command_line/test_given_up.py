"""A console that is stopped (SIGSTOP): whoever asks is told at once, and what was given up is not begun later."""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import cells
import pytest
from cells import CellFolder
from served import Browser, Served, served
from websockets.sync.client import connect

SAID_WITHIN_S = 2.0
NOT_LATER_S = 2.0
"""For so long the queue is watched for what must not enter it."""


@pytest.fixture(scope="module")
def stopped_at_will(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[CellFolder, Served, Browser]]:
    cell = CellFolder(tmp_path_factory.mktemp("served"))
    with served(cell) as service:
        yield cell, service, service.browser(token=service.token)


@contextmanager
def frozen(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def _all_of(connection: socket.socket) -> str:
    found = b""
    while b"ask again" not in found and (more := connection.recv(65536)):
        found += more
    return found.decode()


def stays_empty(engineer: Browser) -> bool:
    """Nothing enters the queue for a while."""
    end_s = time.monotonic() + NOT_LATER_S
    while time.monotonic() < end_s:
        state = engineer.state()
        if state["queue"] or state["checking"]:
            return False
        time.sleep(0.1)
    return True


@pytest.mark.parametrize("command", ["queue", "acquire"])
def test_what_was_given_up_while_the_console_was_stopped_is_not_begun_later(
    stopped_at_will: tuple[CellFolder, Served, Browser], command: str
) -> None:
    cell, service, engineer = stopped_at_will
    pid = service.process.pid
    with frozen(pid):
        asked = cells.start(*{"queue": ("queue", cell.rig, cell.plan), "acquire": ("acquire", cell.plan)}[command])
        assert asked.stderr is not None
        line = asked.stderr.readline()
        assert f"process {pid} is stopped" in line
        assert f"kill -CONT {pid}" in line
        asked.send_signal(signal.SIGINT)
        ended = cells.finish(asked)
    assert ended.code == 130
    if command == "queue":
        assert "will not carry out the request" in ended.err
    assert stays_empty(engineer)


def test_a_page_that_has_gone_begins_nothing_and_neither_does_what_lay_for_long(
    stopped_at_will: tuple[CellFolder, Served, Browser],
) -> None:
    _, service, engineer = stopped_at_will
    place = urlsplit(service.url)
    tokens = [engineer.token() for _ in range(2)]
    body = json.dumps({"plan": "plan.yaml"}).encode()

    def send(token: str) -> socket.socket:
        connection = socket.create_connection((place.hostname, place.port), 30)
        head = (
            f"POST /api/v1/queue HTTP/1.1\r\nHost: {place.netloc}\r\nCookie: {engineer.cookie}\r\n"
            f"X-Coupole-Token: {token}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        connection.sendall(head.encode() + body)
        return connection

    with frozen(service.process.pid):
        send(tokens[0]).close()
    assert stays_empty(engineer)
    with frozen(service.process.pid):
        waits = send(tokens[1])
        time.sleep(6.0)
    with waits:
        answer = _all_of(waits)
    assert " 409 " in answer.splitlines()[0]
    assert "was frozen for" in answer
    assert stays_empty(engineer)


def test_a_command_that_waits_for_a_stopped_console_is_answered_when_it_runs_again(
    stopped_at_will: tuple[CellFolder, Served, Browser],
) -> None:
    cell, service, _ = stopped_at_will
    with frozen(service.process.pid):
        asked = cells.start("queue", cell.rig, "--json")
        assert asked.stderr is not None
        assert "is stopped" in asked.stderr.readline()
    ended = cells.finish(asked)
    assert (ended.code, ended.document["state"]) == (0, "idle")


def test_a_console_that_does_not_listen_yet_is_waited_for_and_named(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    process = cells.start("serve", cell.rig, "--port", "0", "--json", "--plans", cell.folder)
    lock = cell.folder / "storage/state/console/lock"
    try:
        cells.wait_until(lambda: lock.is_file() and lock.read_text(), "the console's lock")
        process.send_signal(signal.SIGSTOP)
        for command in (("queue", cell.rig), ("acquire", cell.plan, "--yes")):
            asked = cells.start(*command)
            assert asked.stderr is not None
            line = asked.stderr.readline()
            assert f"process {process.pid} is stopped" in line, line
            asked.send_signal(signal.SIGINT)
            assert cells.finish(asked).code == 130
        asked = cells.start("queue", cell.rig)
        assert asked.stderr is not None
        asked.stderr.readline()
        process.send_signal(signal.SIGCONT)
        ended = cells.finish(asked)
        assert ended.code == 0, ended.err
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["pid"] == process.pid
    finally:
        process.kill()
        cells.finish(process)


def test_a_button_that_was_pressed_while_the_console_was_stopped_moves_nothing(
    stopped_at_will: tuple[CellFolder, Served, Browser],
) -> None:
    _, service, engineer = stopped_at_will
    place = f"{service.url.replace('http', 'ws')}/api/v1/bench/hold"
    headers = {"Cookie": engineer.cookie, "Origin": service.url}
    with connect(place, additional_headers=headers) as button:
        with frozen(service.process.pid):
            button.send(json.dumps({"axis": "A1", "direction": 1, "share": 0.1}))
            time.sleep(1.5)
        assert "the console was frozen for 1." in json.loads(button.recv(cells.PATIENCE_S))["ended"]

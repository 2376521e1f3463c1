"""Notifications, as a mail server and a web server of the tests' own receive them."""

from __future__ import annotations

import email
import http.server
import json
import os
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from email.message import Message as Mail
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder

from coupole.console.plans.plan_queue import PlanQueue
from coupole.console.upkeep import notifications
from coupole.console.upkeep import notifier as module
from coupole.console.upkeep.notifications import NAME, console_folder, read_settings
from coupole.console.upkeep.notifier import Notifier, Occurrences
from coupole.errors import InputError
from coupole.plan.cell import Cell, read_cell
from coupole.storage.arm_faults import faults_of

MAILS: list[tuple[str, list[str], Mail]] = []
POSTS: list[tuple[dict[str, str], dict[str, Any]]] = []


class MailServer(socketserver.StreamRequestHandler):
    """What RFC 5321 asks of a server, as far as one mail needs it."""

    def handle(self) -> None:
        self._say("220 test")
        sender, receivers = "", list[str]()
        while line := self.rfile.readline().decode().strip():
            word = line.upper()
            if word.startswith("MAIL FROM:"):
                sender = line.partition("<")[2].partition(">")[0]
            elif word.startswith("RCPT TO:"):
                receivers.append(line.partition("<")[2].partition(">")[0])
                if receivers[-1].startswith("nobody"):
                    self._say("550 no such user")
                    continue
            elif word == "DATA":
                self._say("354 go on")
                text = b""
                while (part := self.rfile.readline()) != b".\r\n":
                    text += part
                MAILS.append((sender, receivers, email.message_from_bytes(text)))
            self._say("221 bye" if word == "QUIT" else "250 fine")

    def _say(self, words: str) -> None:
        self.wfile.write(f"{words}\r\n".encode())


class WebServer(http.server.BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        POSTS.append((dict(self.headers), json.loads(body)))
        moved = self.path == "/moved"
        self.send_response(302 if moved else 204)
        if moved:
            self.send_header("Location", "/elsewhere")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def servers() -> Iterator[tuple[int, int]]:
    """Ports of a mail server and a web server."""
    MAILS.clear()
    POSTS.clear()
    mail, web = (
        socketserver.ThreadingTCPServer(("127.0.0.1", 0), MailServer),
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), WebServer),
    )
    for server in (mail, web):
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    yield mail.server_address[1], web.server_address[1]
    for server in (mail, web):
        server.shutdown()
        server.server_close()


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    found = read_cell(CellFolder(tmp_path).rig)
    console_folder(found).mkdir(parents=True)
    return found


def write(cell: Cell, **settings: Any) -> Path:
    path = console_folder(cell) / NAME
    path.write_text(json.dumps({"schema_version": 1, **settings}))
    path.chmod(0o600)
    return path


def by_mail(port: int, to: str = "ada@example.org") -> dict[str, Any]:
    return {"server": "127.0.0.1", "port": port, "security": "none", "sender": "dome@example.org", "to": [to]}


def test_what_happens_at_a_cell_reaches_people_by_mail_and_by_webhook(
    cell: Cell, servers: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LOOK_EVERY_S", 0.05)
    queue = PlanQueue(console_folder(cell) / "queue.json")
    old = queue.add("Ada", plan="/plans/old.yaml")
    queue.conclude(old.id, state="done", ended="2026-01-01T00:00:00.000Z")
    hook = {"url": f"http://127.0.0.1:{servers[1]}/hook", "headers": {"Authorization": "Bearer mine"}}
    write(cell, disk_low_gb=1e9, email=by_mail(servers[0]), webhooks=[hook])
    settings = read_settings(console_folder(cell))
    assert settings is not None
    occurrences = Occurrences(cell, queue, settings.disk_low_gb)
    good, bad = queue.add("Ada", plan="/plans/good.yaml"), queue.add("Ada", plan="/plans/bad.yaml")
    hold = queue.add("Ada", hold="change the\nobject")
    queue.conclude(good.id, state="done", ended="2026-01-01T00:00:01.000Z", run="/runs/good")
    why = {"said": "no light", "halt": "bad.yaml: no light"}
    queue.conclude(bad.id, state="failed", ended="2026-01-01T00:00:02.000Z", **why)
    queue.conclude(hold.id, state="done", ended="2026-01-01T00:00:03.000Z", halt=hold.words)
    faults_of(cell).note("axis 3 is blocked")
    log = console_folder(cell) / "notifications.jsonl"
    with Notifier(settings, occurrences, console_folder(cell)) as notifier:
        cells.wait_until(lambda: log.is_file() and log.read_text().count("\n") >= 10, "five messages by two ways")
        time.sleep(0.3)
        assert notifier.trouble == ""
    assert [post["event"] for _, post in POSTS] == ["plan-ended", "fault", "hold", "arm-fault", "disk-low"]
    headers, post = POSTS[0]
    assert headers["Authorization"] == "Bearer mine"
    assert (post["cell"], post["subject"]) == (cell.rig.name, f"{cell.rig.name}: good.yaml is done")
    assert "/runs/good" in post["text"]
    assert "no light" in POSTS[1][1]["text"]
    sender, receivers, mail = MAILS[2]
    assert (sender, receivers, mail["To"]) == ("dome@example.org", ["ada@example.org"], "ada@example.org")
    assert mail["Subject"] == f"{cell.rig.name}: hold: change the object"
    assert "axis 3 is blocked" in str(MAILS[3][2].get_payload())
    lines = log.read_text().splitlines()
    assert [json.loads(line)["trouble"] for line in lines] == [""] * 10


def test_a_server_that_is_silent_or_refuses_holds_up_nobody_and_is_told(
    cell: Cell, servers: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LOOK_EVERY_S", 0.05)
    monkeypatch.setattr(module, "_AGAIN_AFTER_S", 0.05)
    monkeypatch.setattr(notifications, "_PATIENCE_S", 0.5)
    silent = socket.create_server(("127.0.0.1", 0))
    queue = PlanQueue(console_folder(cell) / "queue.json")
    write(
        cell,
        events=["hold"],
        email=by_mail(servers[0], "nobody@example.org"),
        webhooks=[
            {"url": f"http://127.0.0.1:{servers[1]}/moved"},
            {"url": f"http://127.0.0.1:{silent.getsockname()[1]}"},
        ],
    )
    settings = read_settings(console_folder(cell))
    assert settings is not None
    occurrences = Occurrences(cell, queue, 0.0)
    with silent, Notifier(settings, occurrences, console_folder(cell)) as notifier:
        ended = queue.add("Ada", plan="/plans/untold.yaml")
        queue.conclude(ended.id, state="done", ended="2026-01-01T00:00:01.000Z")
        hold = queue.add("Ada", hold="lunch")
        queue.conclude(hold.id, state="done", ended="2026-01-01T00:00:03.000Z", halt=hold.words)
        cells.wait_until(lambda: notifier.trouble, "what was not sent")
        assert [words for words in ("no such user", "302", "timed out") if words not in notifier.trouble] == []
    assert {post["event"] for _, post in POSTS} == {"hold"}
    assert len(POSTS) == 3, "tried again, and led nowhere else"


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (
            {"email": {**by_mail(25), "server": "smtp.example.org", "user": "a", "password": "b"}},
            "without encryption",
        ),
        ({"email": {**by_mail(25), "sender": "dome@example.org\nBcc: all@example.org"}}, "sender"),
        ({"webhooks": [{"url": "file:///etc/passwd"}]}, "url"),
        ({"events": ["lunch"]}, "events"),
    ],
)
def test_settings_that_cannot_be_right_are_refused(cell: Cell, settings: dict[str, Any], says: str) -> None:
    write(cell, **settings)
    with pytest.raises(InputError, match=says):
        read_settings(console_folder(cell))


def test_ways_are_tried_from_the_command_line(
    cell: Cell, servers: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = ("serve", cell.document.path, "--test-notifications")
    assert f"{console_folder(cell) / NAME}: no such file" in cells.here(*test).err
    tool = tmp_path / "notify-send"
    tool.write_text(f'#!/bin/sh\nprintf "%s|" "$@" > {tmp_path}/shown\n')
    tool.chmod(0o700)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    path = write(cell, email=by_mail(servers[0]), desktop=True)
    ended = cells.here(*test, "--json")
    assert (ended.code, ended.document) == (0, {"e-mail by 127.0.0.1": "", "desktop": ""}), ended.err
    assert MAILS[0][2]["Subject"].endswith("a test of its notifications")
    assert (tmp_path / "shown").read_text().split("|")[2:4] == ["--", MAILS[0][2]["Subject"]]
    path.chmod(0o644)
    assert "only its owner may read" in cells.here(*test).err

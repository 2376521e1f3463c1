"""The live view's page over HTTP: who may see it, who may switch lights, and what a hostile client can do."""

from __future__ import annotations

import contextlib
import http.client
import json
import random
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import cells
import numpy as np
import pytest

from coupole.viewing import live_page
from coupole.viewing.live import Choice, Shown, Studio
from coupole.viewing.live_page import MOST_CONNECTIONS, LiveServer, serve
from coupole.viewing.raw_preview import Coding, figures

LEDS = tuple(range(10))
BEGUN_WITH = Choice(3, 8000)
RAW = np.arange(32 * 48, dtype=np.uint16).reshape(32, 48)
CODING = Coding("GBRG", 64, 4095)
SHOWN = Shown(1, "LED 3", RAW, CODING, 8000, 3, figures(RAW, CODING), 5.0, 0.1)
PAGE_HEADERS = {"X-Coupole-Live": "1"}


@pytest.fixture
def studio() -> Studio:
    found = Studio(BEGUN_WITH)
    found.show(SHOWN)
    return found


@pytest.fixture
def server(studio: Studio) -> Iterator[LiveServer]:
    opened = serve(studio, LEDS, 100_000, 0)
    thread = threading.Thread(target=opened.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield opened
    opened.shutdown()
    opened.server_close()
    thread.join()


def token(server: LiveServer) -> str:
    found = re.fullmatch(r"http://127\.0\.0\.1:\d+/([\w-]{20,})/", server.url)
    assert found
    return found[1]


def ask(
    server: LiveServer, method: str, path: str, body: bytes | None = None, headers: dict[str, str] | None = None
) -> tuple[int, http.client.HTTPMessage, bytes]:
    link = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=cells.PATIENCE_S)
    link.request(method, path, body, headers or {})
    reply = link.getresponse()
    content = reply.read()
    link.close()
    return reply.status, reply.headers, content


def choose(server: LiveServer, body: bytes, headers: dict[str, str] | None = None) -> tuple[int, str]:
    code, _, said = ask(server, "POST", f"/{token(server)}/choose", body, {**PAGE_HEADERS, **(headers or {})})
    return code, said.decode()


def test_the_address_works_and_nothing_below_another_token(server: LiveServer, studio: Studio) -> None:
    for path in ("", "figures", "picture"):
        assert ask(server, "GET", f"/{token(server)}/{path}")[0] == 200
        for wrong in ("", "/", f"/{path}", f"/x{token(server)}/{path}", f"/{token(server)[:-1]}/{path}"):
            code, _, body = ask(server, "GET", wrong)
            assert code in (400, 403)
            assert b"LED" not in body
    assert ask(server, "POST", "/choose", b'{"led": 4}', PAGE_HEADERS)[0] == 403
    assert studio.choice == BEGUN_WITH
    assert token(server) != token(serve_another(studio))


def serve_another(studio: Studio) -> LiveServer:
    other = serve(studio, LEDS, 100_000, 0)
    other.server_close()
    return other


@pytest.mark.parametrize("path", ["", "figures", "picture", "no-such", "../wrong"])
def test_no_answer_may_be_framed_guessed_kept_or_told_to_other_sites(server: LiveServer, path: str) -> None:
    _, headers, _ = ask(server, "GET", f"/{token(server)}/{path}")
    policy = headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert headers["Cache-Control"] == "no-store"
    assert "Python" not in headers["Server"]


def test_a_choice_is_taken_as_it_is_meant(server: LiveServer, studio: Studio) -> None:
    assert choose(server, b'{"led": 4}')[0] == 200
    assert studio.choice == Choice(4, 8000)
    assert choose(server, b'{"led": null, "exposure_us": 500}')[0] == 200
    assert studio.choice == Choice(None, 500)
    assert choose(server, b"{}")[0] == 200
    assert studio.choice == Choice(None, 500)


@pytest.mark.parametrize(
    "body",
    [
        b'{"led": true}',
        b'{"led": false}',
        b'{"led": 4.0}',
        b'{"led": "4"}',
        b'{"led": [4]}',
        b'{"led": -1}',
        b'{"led": 10}',
        b'{"led": 1e400}',
        b'{"led": 99999999999999999999999999}',
        b'{"led": 4, "also": 1}',
        b'{"exposure_us": true}',
        b'{"exposure_us": null}',
        b'{"exposure_us": 8000.0}',
        b'{"exposure_us": 9}',
        b'{"exposure_us": 100001}',
        b'{"exposure_us": NaN}',
        b"[4]",
        b"4",
        b"",
        b"\xff",
        b"[" * 4000,
        b'{"led": 4',
    ],
)
def test_a_choice_that_is_no_choice_is_refused_and_changes_nothing(
    server: LiveServer, studio: Studio, body: bytes
) -> None:
    code, said = choose(server, body)
    assert code == 400, said
    assert studio.choice == BEGUN_WITH


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "example.org"},
        {"Host": "127.0.0.1.example.org"},
        {"Host": "localhost:80@example.org"},
        {"Host": ""},
        {"Origin": "http://example.org"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"X-Coupole-Live": "0"},
    ],
    ids=str,
)
def test_other_names_and_other_sites_are_refused(
    server: LiveServer, studio: Studio, headers: dict[str, str]
) -> None:
    assert choose(server, b'{"led": 4}', headers)[0] in (400, 403)
    assert studio.choice == BEGUN_WITH
    if "X-Coupole-Live" not in headers:
        assert ask(server, "GET", f"/{token(server)}/picture", None, headers)[0] == 403


def raw(server: LiveServer, data: bytes) -> bytes:
    """Whatever comes back for these bytes, until the server hangs up."""
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=cells.PATIENCE_S) as link:
        got = b""
        with contextlib.suppress(OSError):  # the server may hang up first
            link.sendall(data)
            link.shutdown(socket.SHUT_WR)
            while more := link.recv(65536):
                got += more
        return got


@pytest.mark.parametrize("length", ["-1", "+5", "1_0", "5, 5", "\u0665", "0x5", "5000", ""])
def test_a_length_that_is_none_is_refused_and_not_waited_for(
    server: LiveServer, studio: Studio, length: str
) -> None:
    head = f"POST /{token(server)}/choose HTTP/1.1\r\nHost: localhost\r\nX-Coupole-Live: 1\r\nContent-Length: "
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as link:
        link.sendall(head.encode() + length.encode() + b'\r\n\r\n{"led": 4}')
        assert link.recv(100).split()[1] in (b"400", b"413")
    assert studio.choice == BEGUN_WITH


def test_a_target_that_is_no_path_is_refused(server: LiveServer) -> None:
    assert raw(server, b"GET http://[/x HTTP/1.1\r\nHost: localhost\r\n\r\n").split()[1] == b"400"


def test_two_host_headers_are_refused(server: LiveServer) -> None:
    head = f"GET /{token(server)}/figures HTTP/1.1\r\nHost: localhost\r\n"
    assert raw(server, f"{head}\r\n".encode()).split()[1] == b"200"
    assert raw(server, f"{head}Host: example.org\r\n\r\n".encode()).split()[1] == b"403"


def test_only_pages_that_ask_count_as_viewers(server: LiveServer, studio: Studio) -> None:
    studio._asked_s -= 1e6
    ask(server, "GET", f"/{token(server)}/")
    ask(server, "GET", "/wrong/figures")
    ask(server, "GET", f"/{token(server)}/figures", None, {"Host": "example.org"})
    assert not studio.is_watched
    ask(server, "GET", f"/{token(server)}/figures")
    assert studio.is_watched


# -- slow clients ------------------------------------------------------------------------------------------------


def test_many_slow_clients_hold_few_threads_and_nobody_up(
    server: LiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "_REQUEST_S", 1e6)  # it is not their time that ends them
    monkeypatch.setattr(live_page._Viewer, "timeout", None)
    before = threading.active_count()
    with ExitStack() as slow:
        for _ in range(4 * MOST_CONNECTIONS):
            link = slow.enter_context(socket.create_connection(("127.0.0.1", server.server_port)))
            link.sendall(b"GET / HTTP/1.1\r\nHost: ")
        cells.wait_until(lambda: threading.active_count() <= before + MOST_CONNECTIONS, "few threads")
        assert ask(server, "GET", f"/{token(server)}/figures")[0] == 200


def test_a_client_that_sends_byte_after_byte_is_cut_off_in_time(
    server: LiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "_REQUEST_S", 0.2)
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=cells.PATIENCE_S) as link:
        link.sendall(b"GET / HTTP/1.1\r\nX-More: ")

        def cut_off() -> bool:
            try:
                link.sendall(b"x")
            except ConnectionError:
                return True
            return False

        cells.wait_until(cut_off, "the end of its time")


# -- fuzz --------------------------------------------------------------------------------------------------------

WORDS = (
    b"GET POST HEAD PUT OPTIONS / // http://[ ? # %00 .. HTTP/1.1 HTTP/1.0 HTTP/0.9 HTTP/9.9 HTTP/x Host: "
    b"localhost 127.0.0.1 example.org Content-Length: Transfer-Encoding: chunked Expect: 100-continue "
    b'X-Coupole-Live: 1 0 -1 99999 {"led":4} {"led":true} Origin: null choose figures picture picture?mark=%ff '
    b"\xff\xfe \x00"
).split(b" ")


def drawn(random_: random.Random, secret: bytes) -> bytes:
    """A request that is whole, mutated, put together at random, or nothing but bytes; never a valid choice."""
    headers = b"Host: localhost\r\nX-Coupole-Live: 1\r\nContent-Length: 13\r\n"
    request = bytearray(b"POST /" + secret + b"/choose HTTP/1.1\r\n" + headers + b'\r\n{"led": true}')
    match random_.randrange(4):
        case 0:
            for _ in range(random_.randint(1, 8)):
                request[random_.randrange(len(request))] = random_.randrange(256)
        case 1:
            at = random_.randrange(len(request))
            request[at : at + random_.randint(0, 30)] = random_.choice(WORDS) * random_.choice((1, 1, 3, 5000))
        case 2:
            separators = (b" ", b"\r\n", b"\r\n\r\n", b": ", b"/")
            parts = (random_.choice((*WORDS, secret)) + random_.choice(separators) for _ in range(30))
            request = bytearray(b"".join(parts))
        case 3:
            request = bytearray(random_.randbytes(random_.randint(0, 300)))
    return bytes(request)


def test_random_requests_change_no_light_and_leave_no_traceback(
    server: LiveServer, studio: Studio, capfd: pytest.CaptureFixture[str]
) -> None:
    random_ = random.Random(1)
    taken, threads = 0, threading.active_count()
    for _ in range(400):
        reply = raw(server, drawn(random_, token(server).encode()))
        taken += reply.startswith(b"HTTP/1.0 200")
        assert b"Traceback" not in reply
        assert studio.choice == BEGUN_WITH
    assert taken < 100, "most are refused"
    assert ask(server, "GET", f"/{token(server)}/figures")[0] == 200
    cells.wait_until(lambda: threading.active_count() <= threads, "the end of all connections")
    assert capfd.readouterr().err == ""


def test_the_figures_say_what_the_source_remarks(server: LiveServer, studio: Studio) -> None:
    studio.remark = "no page is open"
    shown = json.loads(ask(server, "GET", f"/{token(server)}/figures")[2])
    assert shown["remark"] == "no page is open"
    assert shown["choice"] == {"led": 3, "exposure_us": 8000}

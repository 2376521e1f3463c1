"""The live view's web page. It is served only on this machine, and only to users who know its address.

The address contains a token that is new each time. A request is refused if it uses another host name (DNS
rebinding), comes from a page of another site, or is not exactly as the page sends it. Each connection has one
request, a bounded time and one of a few threads. So a client that is slow or hangs does not delay others.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import json
import re
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

from coupole.errors import InputError
from coupole.viewing.live import Studio, choice_from, read_wanted
from coupole.viewing.raw_preview import look

_WIDTH_PX = 960
_REQUEST_S = 10.0
"""A connection is closed after this time, whatever its state."""
MOST_CONNECTIONS = 16
"""Greatest number of connections at the same time. One more connection closes the oldest. A page has two, for some
milliseconds each."""
_MOST_POSTED = 4096
_OURS = "X-Coupole-Live"
"""Browsers send this header only for pages of this server, so no other site can switch LEDs."""
_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?", re.ASCII)
_ORIGIN = re.compile(r"http://" + _HOST.pattern, re.ASCII)
_LENGTH = re.compile(r"[0-9]{1,4}", re.ASCII)


class Refused(Exception):
    """Raised when the server refuses a request."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Answer:
    """Content type and body."""

    kind: str
    body: bytes


@dataclass(frozen=True)
class _Page:
    """The page, with the state that all viewers share."""

    html: bytes
    studio: Studio
    leds: tuple[int, ...]
    """Ids that may be chosen; empty while a run is watched."""
    longest_us: int
    token: str

    def get(self, target: str) -> Answer:
        """Return page, figures or picture for a path with its query. Raises Refused."""
        path, query = self._place(target)
        if path == "":
            return Answer("text/html; charset=utf-8", self.html)
        if path == "figures":
            self.studio.note_request()
            return Answer("application/json", self._figures())
        frame = self.studio.shown_frame
        if path == "picture" and frame is not None:
            self.studio.note_request()
            marks = parse_qs(query).get("mark", [""])[0].split(",")
            picture = look(
                frame.raw, frame.coding, _WIDTH_PX, saturation="saturation" in marks, focus="focus" in marks
            )
            return Answer("image/jpeg", picture)
        raise Refused(HTTPStatus.NOT_FOUND, "nothing here yet")

    def choose(self, target: str, body: bytes) -> Answer:
        """Take a viewer's choice and return the figures. Raises Refused, or InputError if it is not valid."""
        if self._place(target)[0] != "choose":
            raise Refused(HTTPStatus.NOT_FOUND, "choices go to `choose`")
        if not self.leds:
            raise InputError("this is a run: light and exposure follow its plan")
        self.studio.choose(choice_from(read_wanted(body), self.studio.choice, self.leds, self.longest_us))
        return Answer("application/json", self._figures())

    def _place(self, target: str) -> tuple[str, str]:
        """Return the path after the token, and the query. Raises Refused if the token is wrong."""
        try:
            url = urlsplit(target)
        except ValueError as error:
            raise Refused(HTTPStatus.BAD_REQUEST, "this is no path") from error
        _, _, below = url.path.partition("/")
        token, slash, path = below.partition("/")
        if not slash or not hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode()):
            raise Refused(HTTPStatus.FORBIDDEN, "use the whole address that the terminal shows")
        return path, url.query

    def _figures(self) -> bytes:
        return json.dumps(_figures(self.studio, self.leds)).encode()


class LiveServer(ThreadingHTTPServer):
    """Serves the page on 127.0.0.1. Call `serve_forever` on a thread, and `shutdown` to end it."""

    daemon_threads = True
    request_queue_size = 2 * MOST_CONNECTIONS

    def __init__(self, page: _Page, port: int) -> None:
        self._page, self.policy = page, _policy(page.html)
        self._lock = threading.Lock()
        self._since_s: dict[socket.socket, float] = {}
        """Open connections, oldest first."""
        super().__init__(("127.0.0.1", port), _Viewer)

    @property
    def page(self) -> _Page:
        return self._page

    @property
    def url(self) -> str:
        """The page's address, with its token."""
        return f"http://127.0.0.1:{self.server_port}/{self._page.token}/"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Take a connection. If there are more than `MOST_CONNECTIONS`, the oldest is closed."""
        with self._lock:
            if len(self._since_s) >= MOST_CONNECTIONS:
                oldest = next(iter(self._since_s))
                del self._since_s[oldest]
                _hang_up(oldest)
            self._since_s[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._since_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Called twice a second: close connections whose time is over."""
        with self._lock:
            for request, since_s in self._since_s.items():
                if time.monotonic() - since_s > _REQUEST_S:
                    _hang_up(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a broken connection, which is not an error of this server. Print any other exception."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Viewer(BaseHTTPRequestHandler):
    """One viewer's connection."""

    server: LiveServer
    server_version, sys_version = "coupole", ""
    timeout = _REQUEST_S

    def do_GET(self) -> None:
        """Answer with page, picture or figures."""
        self._answer_with(lambda: self.server.page.get(self.path))

    def do_POST(self) -> None:
        """Take a viewer's choice: {"led": 417, "exposure_us": 8000}; led is null for none."""
        self._answer_with(lambda: self.server.page.choose(self.path, self._read_body()))

    def _answer_with(self, work: Callable[[], Answer]) -> None:
        try:
            self._refuse_others()
            answer = work()
        except Refused as refused:
            self._send(refused.status, Answer("text/plain; charset=utf-8", str(refused).encode()))
        except InputError as error:
            self._send(HTTPStatus.BAD_REQUEST, Answer("text/plain; charset=utf-8", str(error).encode()))
        else:
            self._send(HTTPStatus.OK, answer)

    def _refuse_others(self) -> None:
        """Refuse a request with a host name that is not this machine's, because another site may have sent it."""
        hosts, origins = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            raise Refused(HTTPStatus.FORBIDDEN, "ask 127.0.0.1")
        if any(not _ORIGIN.fullmatch(origin) for origin in origins):
            raise Refused(HTTPStatus.FORBIDDEN, "the page of another site may not ask")
        if self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            raise Refused(HTTPStatus.FORBIDDEN, "the page of another site may not ask")

    def _read_body(self) -> bytes:
        if self.headers.get(_OURS) != "1":
            raise InputError("only the page of this server may change light and exposure")
        lengths = self.headers.get_all("Content-Length", [])
        if len(lengths) != 1 or not _LENGTH.fullmatch(lengths[0]) or "Transfer-Encoding" in self.headers:
            raise InputError(f"expected one Content-Length of at most {_MOST_POSTED} bytes")
        size = int(lengths[0])
        if size > _MOST_POSTED:
            raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {_MOST_POSTED} bytes")
        return self.rfile.read(size)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send plain text instead of the base class's page, for requests that it cannot read and for other
        methods."""
        self._send(HTTPStatus(code), Answer("text/plain; charset=utf-8", HTTPStatus(code).phrase.encode()))

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        self.close_connection = True
        self.send_response(status)
        for name, value in {
            "Content-Type": answer.kind,
            "Content-Length": str(len(answer.body)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": self.server.policy,
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
        }.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  the base class names it so
        """Do not log requests."""


def serve(studio: Studio, leds: tuple[int, ...], longest_us: int, port: int) -> LiveServer:
    """Return a server; its page is at its `url`. `leds` are the ids that a viewer may choose, `longest_us` the
    longest exposure. Raises OSError if the port cannot be taken."""
    html = resources.files("coupole.viewing").joinpath("live.html").read_bytes()
    return LiveServer(_Page(html, studio, leds, longest_us, secrets.token_urlsafe(16)), port)


def _policy(html: bytes) -> str:
    """Return a policy that allows only the page's own script and style, by their hashes, and that forbids frames
    around the page."""
    hashes = {
        tag: base64.b64encode(hashlib.sha256(_content(html, tag)).digest()).decode() for tag in ("script", "style")
    }
    return (
        f"default-src 'none'; script-src 'sha256-{hashes['script']}'; style-src 'sha256-{hashes['style']}'; "
        "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _content(html: bytes, tag: str) -> bytes:
    """Return the content of the page's only element of this name."""
    _, _, after = html.partition(f"<{tag}>".encode())
    return after.partition(f"</{tag}>".encode())[0]


def _hang_up(connection: socket.socket) -> None:
    """Close the connection, so that its thread ends."""
    with contextlib.suppress(OSError):  # it is closed already
        connection.shutdown(socket.SHUT_RDWR)


def _figures(studio: Studio, leds: tuple[int, ...]) -> dict[str, Any]:
    frame, choice = studio.shown_frame, studio.choice
    document = {}
    if frame is not None:
        document = {
            "number": frame.number,
            "title": frame.title,
            "led": frame.led,
            "exposure_us": frame.exposure_us,
            "frames_per_s": round(frame.frames_per_s, 2),
            "dose_lux_h": frame.dose_lux_h,
            "run": frame.run,
            **asdict(frame.figures),
        }
    return {
        "shown": document,
        "choice": asdict(choice),
        "leds": len(leds) and [min(leds), max(leds)],
        "remark": studio.remark,
    }

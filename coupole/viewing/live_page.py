"""The live view's web page, served to this machine only, on daemon threads."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

from coupole.errors import InputError
from coupole.viewing.live import Studio, choice_from
from coupole.viewing.raw_preview import look

_WIDTH_PX = 960
_VIEWER_S = 10.0
"""The connection of a viewer that takes no bytes for so long is closed."""
_MOST_POSTED = 4096
_OURS = "X-Coupole-Live"
"""Browsers send this header only for pages of this server, so no other site can switch LEDs."""


@dataclass(frozen=True)
class _Page:
    """The page, with the state that all viewers share."""

    html: bytes
    studio: Studio
    leds: tuple[int, ...]
    """Ids that may be chosen; empty while a run is watched."""
    longest_us: int

    def get(self, target: str) -> tuple[int, str, bytes]:
        """Status, content type and body for a path with its query: page, figures or picture."""
        url = urlsplit(target)
        shown = self.studio.shown
        if url.path == "/":
            return 200, "text/html; charset=utf-8", self.html
        if url.path == "/figures":
            return 200, "application/json", self._figures()
        if url.path == "/picture" and shown is not None:
            marks = parse_qs(url.query).get("mark", [""])[0].split(",")
            picture = look(
                shown.raw, shown.coding, _WIDTH_PX, saturation="saturation" in marks, focus="focus" in marks
            )
            return 200, "image/jpeg", picture
        return 404, "text/plain", b"nothing here yet"

    def choose(self, posted: bytes) -> bytes:
        """Take a viewer's choice and return the figures. Raises InputError or ValueError if it is not valid."""
        wanted = json.loads(posted)
        if not isinstance(wanted, dict):
            raise InputError('expected an object, like {"led": 417}')
        self.studio.choose(choice_from(wanted, self.studio.choice, self.leds, self.longest_us))
        return self._figures()

    def _figures(self) -> bytes:
        return json.dumps(_figures(self.studio, self.leds)).encode()


def serve(studio: Studio, leds: tuple[int, ...], longest_us: int, port: int) -> ThreadingHTTPServer:
    """A server on 127.0.0.1, its port in `server_port`; call `serve_forever` on a thread, `shutdown` to end.

    `leds` are the ids that a viewer may choose, `longest_us` the longest exposure.
    """
    html = resources.files("coupole.viewing").joinpath("live.html").read_bytes()
    page = _Page(html, studio, leds, longest_us)

    class Viewer(BaseHTTPRequestHandler):
        """One viewer's connection."""

        timeout = _VIEWER_S

        def do_GET(self) -> None:
            """Page, picture or figures."""
            if not self._foreign():
                self._answer(*page.get(self.path))

        def do_POST(self) -> None:
            """A viewer's choice: {"led": 417, "exposure_us": 8000}, led null for none."""
            if self._foreign():
                return
            try:
                if self.headers.get(_OURS) != "1":
                    raise InputError("only the page of this server may change light and exposure")
                if not leds:
                    raise InputError("this is a run: light and exposure follow its plan")
                size = min(int(self.headers.get("Content-Length") or 0), _MOST_POSTED)
                figures = page.choose(self.rfile.read(size))
            except (InputError, ValueError) as error:
                self._answer(400, "text/plain; charset=utf-8", str(error).encode())
            else:
                self._answer(200, "application/json", figures)

        def _foreign(self) -> bool:
            """Refuse a request to another name than this machine's own: another site may have sent it."""
            foreign = (self.headers.get("Host") or "").partition(":")[0] not in {"127.0.0.1", "localhost"}
            if foreign:
                self._answer(403, "text/plain", b"ask 127.0.0.1")
            return foreign

        def _answer(self, code: int, kind: str, body: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  the base class names it so
            """Requests are not logged."""

    server = ThreadingHTTPServer(("127.0.0.1", port), Viewer)
    server.daemon_threads = True
    return server


def _figures(studio: Studio, leds: tuple[int, ...]) -> dict[str, Any]:
    shown, choice = studio.shown, studio.choice
    seen = {}
    if shown is not None:
        seen = {
            "number": shown.number,
            "title": shown.title,
            "led": shown.led,
            "exposure_us": shown.exposure_us,
            "frames_per_s": round(shown.frames_per_s, 2),
            "dose_lux_h": shown.dose_lux_h,
            **asdict(shown.figures),
        }
    return {"shown": seen, "choice": asdict(choice), "leds": len(leds) and [min(leds), max(leds)]}

"""The live view's web page: served to this machine only, by threads that nobody waits for."""

from __future__ import annotations

import json
from dataclasses import asdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

from coupole.errors import InputError
from coupole.viewing.live import Studio, choice_from
from coupole.viewing.raw_preview import look

_WIDTH_PX = 960
_VIEWER_S = 10.0
"""A viewer that takes no bytes for so long is given up."""
_MOST_POSTED = 4096
_OURS = "X-Coupole-Live"
"""Browsers send such a header for pages of this server alone: no other site can switch LEDs."""


def serve(studio: Studio, leds: tuple[int, ...], longest_us: int, port: int) -> ThreadingHTTPServer:
    """A server on 127.0.0.1, its port in `server_port`; call `serve_forever` on a thread, `shutdown` to end."""

    page = resources.files("coupole.viewing").joinpath("live.html").read_bytes()

    class Viewer(BaseHTTPRequestHandler):
        """One viewer's connection."""

        timeout = _VIEWER_S

        def do_GET(self) -> None:
            """Page, picture or figures."""
            if self._foreign():
                return
            url = urlsplit(self.path)
            shown = studio.shown
            if url.path == "/":
                self._answer(200, "text/html; charset=utf-8", page)
            elif url.path == "/figures":
                self._answer(200, "application/json", json.dumps(_figures(studio, leds)).encode())
            elif url.path == "/picture" and shown is not None:
                wanted = parse_qs(url.query).get("mark", [""])[0].split(",")
                picture = look(
                    shown.raw, shown.coding, _WIDTH_PX, saturation="saturation" in wanted, focus="focus" in wanted
                )
                self._answer(200, "image/jpeg", picture)
            else:
                self._answer(404, "text/plain", b"nothing here yet")

        def do_POST(self) -> None:
            """A viewer's choice: {"led": 417, "exposure_us": 8000}, led null for none."""
            if self._foreign():
                return
            try:
                if self.headers.get(_OURS) != "1":
                    raise InputError("only the page of this server may choose")
                if not leds:
                    raise InputError("a run is watched: its plan chooses")
                size = min(int(self.headers.get("Content-Length") or 0), _MOST_POSTED)
                wanted = json.loads(self.rfile.read(size))
                if not isinstance(wanted, dict):
                    raise InputError('expected an object, like {"led": 417}')
                studio.choose(choice_from(wanted, studio.choice, leds, longest_us))
            except (InputError, ValueError) as error:
                self._answer(400, "text/plain; charset=utf-8", str(error).encode())
            else:
                self._answer(200, "application/json", json.dumps(_figures(studio, leds)).encode())

        def _foreign(self) -> bool:
            """Asked for by another name than this machine's own: another site's page may be behind it."""
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
            """Viewers are not news."""

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

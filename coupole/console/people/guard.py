"""Check of every request before it is handled. A visitor who is not signed in gets only the sign-in page. A
request changes nothing if it comes from another site's page, or for the second time. Requests that would change
something are logged, with their answers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from anyio import to_thread
from fastapi import FastAPI, Request, Response, WebSocket
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from coupole.console.people.accounts import Account, Role
from coupole.console.people.permission import NotAllowed
from coupole.console.people.sessions import Session
from coupole.console.people.still_wanted import begins_nothing, hung_up
from coupole.console.service_parts import Service
from coupole.errors import CoupoleError, InputError

_READING, _MOST_BYTES = ("GET", "HEAD"), 65536
_MOST_BYTES_OF_A_PICTURE = 20_000_000
_LOOPBACK = ("127.0.0.1", "::1")
_SIGN_IN = Path(__file__).parent / "sign_in.html"
_STATIC = "/_nicegui/"
"""Files of the screens' library. They are the same for everybody, and their names contain their version."""
_SIGN_IN_POLICY = "default-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
_SCREEN_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; frame-src 'self'; "
    "object-src 'none'; base-uri 'self'; form-action 'self'"
)
"""The screens' library compiles its templates in the browser. Nothing is loaded from, or sent to, another
place."""


def guard(app: FastAPI, service: Service) -> None:
    """Put this check in front of an app."""

    @app.middleware("http")
    async def log_request(request: Request, call_next: Callable[[Request], Any]) -> Response:
        status = 500  # the status if the app raises
        try:
            response: Response = await check(request, call_next)
            status = response.status_code
        finally:
            if request.method not in _READING:
                session = getattr(request.state, "session", None)
                name = session.account.name if session else ""
                action, about = f"{request.method} {request.url.path}", getattr(request.state, "about", "")
                log = (name, action, status, address_of(request), about)
                await to_thread.run_sync(service.audit.note, *log)
        return response

    async def check(request: Request, call_next: Callable[[Request], Any]) -> Response:
        most = _MOST_BYTES_OF_A_PICTURE if request.url.path.endswith("/photograph") else _MOST_BYTES
        if int(request.headers.get("content-length", "0") or 0) > most:
            return _no(413, f"expected at most {most} bytes")
        if "transfer-encoding" in request.headers:
            return _no(411, "expected a body whose length is stated")
        if why := _foreign(request, service):
            return why
        session = session_of(request, service)
        request.state.session = session
        public = request.url.path in ("/", "/api/v1/sign-in")
        if session is None and not public:
            return sign_in_page(401) if _wants_page(request) else _no(401, "sign in first")
        if request.method not in _READING and session is not None and not public:
            ambient = not is_command_line(request) and not bearer_of(request)
            if ambient and not service.sessions.spend(session, request.headers.get("x-coupole-token", "")):
                return _no(403, "expected in X-Coupole-Token a fresh token of /api/v1/token, which is valid once")
        if not begins_nothing(request.method, request.url.path) and (refusal := why_unwanted(request, service)):
            return _no(409, refusal)
        response: Response = await call_next(request)
        if not request.url.path.startswith(_STATIC) and "Cache-Control" not in response.headers:
            response.headers["Cache-Control"] = "no-store"
        response.headers.setdefault("Content-Security-Policy", _SCREEN_POLICY)
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers.setdefault("X-Frame-Options", "DENY")
        return response

    app.add_middleware(_WebSocketGuard, service=service)
    _answer_errors(app)


def _answer_errors(app: FastAPI) -> None:
    """Answer errors with their words and their status."""

    @app.exception_handler(InputError)
    async def wrong(_: Request, error: InputError) -> Response:
        return JSONResponse(
            {
                "detail": str(error),
                "problems": [asdict(problem) for problem in error.problems],
                "exit_code": error.exit_code,
            },
            422,
        )

    @app.exception_handler(RequestValidationError)
    async def answer_malformed(_: Request, error: RequestValidationError) -> Response:
        return JSONResponse({"detail": _finite(jsonable_encoder(error.errors()))}, 422)

    @app.exception_handler(CoupoleError)
    async def answer_failure(_: Request, error: CoupoleError) -> Response:
        return JSONResponse({"detail": str(error), "exit_code": error.exit_code}, 409)

    @app.exception_handler(NotAllowed)
    async def not_allowed(_: Request, refusal: NotAllowed) -> Response:
        return _no(refusal.status, str(refusal))


def _finite(content: Any) -> Any:
    """Return a value that JSON can express: numbers that are not finite (such as NaN) become text."""
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    return str(content) if isinstance(content, float) and not math.isfinite(content) else content


class _WebSocketGuard:
    """The same check for the WebSocket connections of the screens."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self._app, self._service = app, service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            socket = WebSocket(scope, receive, send)
            is_own_origin = socket.headers.get("origin") in self._service.origins
            if not is_own_origin or session_of(socket, self._service) is None:
                await socket.close(1008)
                return
        await self._app(scope, receive, send)


def sign_in_page(status: int = 200) -> Response:
    page = _SIGN_IN.read_text(encoding="utf-8")
    return HTMLResponse(
        page, status, headers={"Content-Security-Policy": _SIGN_IN_POLICY, "Cache-Control": "no-store"}
    )


def _wants_page(request: Request) -> bool:
    return request.method == "GET" and "text/html" in request.headers.get("accept", "")


def _foreign(request: Request, service: Service) -> Response | None:
    """Return a refusal if the request comes from another site's page, or if it names another host."""
    hosts = {origin.partition("://")[2] for origin in service.origins}
    if not is_command_line(request) and request.headers.get("host", "") not in hosts:
        return _no(400, "expected this console's own address as host")
    origin = request.headers.get("origin")
    if origin is not None and origin not in service.origins:
        return _no(403, "the request comes from the page of another site")
    return None


def _no(code: int, why: str) -> Response:
    return JSONResponse({"detail": why}, code)


def why_unwanted(request: Request, service: Service) -> str:
    """Return why nothing is begun for a request: its sender has disconnected, or the request may be old. Otherwise
    empty."""
    if hung_up(request.state.connection):
        return "the caller has disconnected: not begun"
    return service.loop_watch.refusal()


def is_command_line(request: Request | WebSocket) -> bool:
    """Tell whether a request came by the service's Unix socket, which accepts only processes of its own user."""
    server = request.scope.get("server")
    return server is not None and server[1] is None


def bearer_of(request: Request | WebSocket) -> str:
    kind, _, secret = request.headers.get("authorization", "").partition(" ")
    return secret if kind == "Bearer" else ""


def address_of(request: Request | WebSocket) -> str:
    """Return the address of the sender."""
    return request.client.host if request.client else "command line"


def session_of(request: Request | WebSocket, service: Service, *, counts_as_use: bool = True) -> Session | None:
    """Return the session of the sender; None if there is none. Requests that only observe do not prolong it."""
    if is_command_line(request):
        return service.command_line
    if bearer := bearer_of(request):
        return service.sessions.of(bearer, script=True, counts_as_use=counts_as_use)
    return service.sessions.of(request.cookies.get(service.cookie, ""), script=False, counts_as_use=counts_as_use)


def is_of_this_machine(request: Request | WebSocket) -> bool:
    """Tell whether a connection comes from an address of this machine, which no other machine can have."""
    if is_command_line(request) or request.client is None:
        return is_command_line(request)
    return request.client.host in _LOOPBACK or request.client.host == request.scope["server"][0]


def account_here(account: Account, *, of_this_machine: bool) -> Account:
    """Return an account with its role at this place: a person at another machine is an observer."""
    return account if of_this_machine else replace(account, role=min(account.role, Role.OBSERVER))

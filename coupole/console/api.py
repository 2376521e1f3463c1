"""The console's HTTP interface, version 1: what it tells, what may be asked of it, and by whom."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from anyio import to_thread
from fastapi import Depends, FastAPI, HTTPException, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse, StreamingResponse

import coupole
from coupole.console.accounts import Account, Accounts, Role
from coupole.console.acquisitions import Acquisitions
from coupole.console.audit import Audit
from coupole.console.entering import Entering
from coupole.console.messages import Hand, NewAccount, NewEntry, SignIn, StateNow, Text
from coupole.console.plan_queue import Entry, PlanQueue
from coupole.console.sessions import Control, Session, Sessions
from coupole.errors import CoupoleError, InputError

_EVENT_EVERY_S, _ALIVE_EVERY_S = 0.2, 1.0
_READING, _MOST_BYTES = ("GET", "HEAD"), 65536
_LOOPBACK = ("127.0.0.1", "::1")
_SIGN_IN = Path(__file__).parent / "sign_in.html"
_POLICY = "default-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"


@dataclass(frozen=True)
class Service:
    """What the interface stands in front of."""

    accounts: Accounts
    sessions: Sessions
    control: Control
    audit: Audit
    queue: PlanQueue
    acquisitions: Acquisitions
    state: Callable[[], StateNow]
    """As it is."""
    newest: Callable[[], StateNow]
    """As it was a moment ago; takes no time."""
    entering: Entering
    origins: frozenset[str]
    """Of this service's own pages."""
    cookie: str
    """Name of the sessions' cookie, which no other console of this machine has."""
    command_line: Session
    """Of the service's own user, on this machine."""


class Refused(HTTPException):
    """With the words for whoever asked."""


def make_app(service: Service) -> FastAPI:
    """The interface, and its schema at /openapi.json."""
    app = FastAPI(title="Coupole console", version=coupole.__version__, docs_url=None, redoc_url=None)
    _guard(app, service)
    _add_sign_in(app, service)
    _add_cell(app, service)
    _add_people(app, service)
    return app


# -- who asks -------------------------------------------------------------------------------------------------


def _guard(app: FastAPI, service: Service) -> None:
    """Nothing but the sign-in page is served to who is not signed in; nothing is changed for another site's page,
    or twice. What was asked and would change something is logged, with its answer."""

    @app.middleware("http")
    async def logged(request: Request, call_next: Callable[[Request], Any]) -> Response:
        response: Response = await check(request, call_next)
        if request.method not in _READING:
            session = getattr(request.state, "session", None)
            name = session.account.name if session else ""
            address = request.client.host if request.client else "command line"
            about = getattr(request.state, "about", "")
            service.audit.note(name, f"{request.method} {request.url.path}", response.status_code, address, about)
        return response

    async def check(request: Request, call_next: Callable[[Request], Any]) -> Response:
        if int(request.headers.get("content-length", "0") or 0) > _MOST_BYTES:
            return _no(413, f"expected at most {_MOST_BYTES} bytes")
        if "transfer-encoding" in request.headers:
            return _no(411, "expected a body with its length")
        hosts = {origin.partition("://")[2] for origin in service.origins}
        if not is_command_line(request) and request.headers.get("host", "") not in hosts:
            return _no(400, "expected this console's own address as host")
        origin = request.headers.get("origin")
        if origin is not None and origin not in service.origins:
            return _no(403, "asked by the page of another site")
        session = _session_of(request, service)
        request.state.session = session
        public = request.url.path in ("/", "/api/v1/sign-in")
        if session is None and not public:
            return _no(401, "sign in first")
        if request.method not in _READING and session is not None and not public:
            ambient = not is_command_line(request) and not _bearer(request)
            if ambient and not service.sessions.spend(session, request.headers.get("x-coupole-token", "")):
                return _no(403, "expected in X-Coupole-Token a fresh token of /api/v1/token, good for once")
        response: Response = await call_next(request)
        response.headers["Cache-Control"] = "no-store"
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["X-Frame-Options"] = "DENY"
        return response

    @app.exception_handler(InputError)
    async def wrong(_: Request, error: InputError) -> Response:
        return JSONResponse({"detail": str(error), "problems": [asdict(one) for one in error.problems]}, 422)

    @app.exception_handler(CoupoleError)
    async def failed(_: Request, error: CoupoleError) -> Response:
        return _no(409, str(error))


def _no(code: int, why: str) -> Response:
    return JSONResponse({"detail": why}, code)


def is_command_line(request: Request) -> bool:
    """By the service's Unix socket, at which only processes of its own user are heard."""
    server = request.scope.get("server")
    return server is not None and server[1] is None


def _bearer(request: Request) -> str:
    kind, _, secret = request.headers.get("authorization", "").partition(" ")
    return secret if kind == "Bearer" else ""


def _session_of(request: Request, service: Service) -> Session | None:
    if is_command_line(request):
        return service.command_line
    if bearer := _bearer(request):
        return service.sessions.of(bearer, script=True)
    return service.sessions.of(request.cookies.get(service.cookie, ""), script=False)


def _is_of_this_machine(request: Request) -> bool:
    """A connection from an address of this machine itself: nobody else can have one."""
    if is_command_line(request) or request.client is None:
        return is_command_line(request)
    return request.client.host in _LOOPBACK or request.client.host == request.scope["server"][0]


def _account(request: Request) -> Account:
    """Whose session it is; from another machine everybody is an observer."""
    session: Session = request.state.session
    account = session.account
    if _is_of_this_machine(request):
        return account
    return replace(account, role=min(account.role, Role.OBSERVER))


Who = Annotated[Account, Depends(_account)]


def allow(service: Service, who: Account, role: Role, action: str, *, acts: bool = False) -> None:
    """Raise Refused if somebody's role, or who is in control, forbids an action."""
    if who.role < role:
        raise Refused(403, f"{action}: only for {role.word}s; {who.name} is {who.role.word}")
    of_command_line = who is service.command_line.account
    if acts and not service.control.act(who, keep=not of_command_line):
        how = "`coupole queue RIG --take-control` takes it" if of_command_line else "ask for it first"
        raise Refused(409, f"{action}: {service.control.now.name} is in control; {how}")


# -- signing in -----------------------------------------------------------------------------------------------


def _add_sign_in(app: FastAPI, service: Service) -> None:
    page = _SIGN_IN.read_text(encoding="utf-8")

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    def front() -> HTMLResponse:
        return HTMLResponse(page, headers={"Content-Security-Policy": _POLICY})

    @app.post("/api/v1/sign-in", responses={401: {"description": "Wrong, or tried too often."}})
    def sign_in(asked: SignIn, request: Request, response: Response) -> dict[str, str]:
        """Begin a session: a cookie for browsers, or for a script `session`, to be sent as `Authorization:
        Bearer`."""
        here = _is_of_this_machine(request)
        if asked.name:
            account = service.accounts.sign_in(asked.name, asked.password, here=here)
        else:
            account = service.accounts.sign_in_first(asked.token) if here else None
        if account is None:
            raise Refused(401, "name or password are wrong, or were wrong too often: try again in a minute")
        secret = service.sessions.begin(account, script=asked.script)
        told = {"name": account.name, "role": account.role.word}
        if asked.script:
            return {**told, "session": secret}
        safe = request.url.scheme == "https"
        response.set_cookie(service.cookie, secret, httponly=True, samesite="strict", secure=safe)
        return told

    @app.post("/api/v1/sign-out")
    def sign_out(who: Who, request: Request, response: Response) -> dict[str, str]:
        """End this session."""
        service.sessions.end(_bearer(request) or request.cookies.get(service.cookie, ""))
        response.delete_cookie(service.cookie)
        return {"name": who.name}

    @app.get("/api/v1/token")
    def token(request: Request) -> dict[str, str]:
        """For the next request that changes something, in its header X-Coupole-Token."""
        return {"token": service.sessions.token(request.state.session)}


# -- the cell -------------------------------------------------------------------------------------------------

REFUSALS: dict[int | str, dict[str, Any]] = {
    403: {"description": "Not for this role, or without a fresh token."},
    409: {"description": "Somebody else is in control, or the cell cannot."},
}


def _add_cell(app: FastAPI, service: Service) -> None:
    @app.get("/api/v1/state")
    def state() -> StateNow:
        """The cell at this moment."""
        return service.state()

    @app.get("/api/v1/events", response_class=StreamingResponse)
    async def events(request: Request) -> StreamingResponse:
        """The state whenever it has changed, and every second, as an event stream (`event: state`), until the
        session is over."""
        return StreamingResponse(_events(service, request), media_type="text/event-stream")

    @app.post("/api/v1/queue", responses=REFUSALS)
    async def add(asked: NewEntry, who: Who, request: Request) -> Entry:
        """Enter a plan, a run to be resumed, or a hold. Preflight is made first, for which this waits; what cannot
        be run with what runs and waits before it is refused with all its problems."""
        allow(service, who, Role.OPERATOR, "queue", acts=True)
        request.state.about = asked.plan or asked.resume or asked.hold
        here = is_command_line(request)
        enter = partial(service.entering.enter, asked, who.name, by_command_line=here)
        quick = asked.now or bool(asked.hold)
        limiter = None if quick else service.entering.one_at_a_time
        return await to_thread.run_sync(enter, limiter=limiter, abandon_on_cancel=True)

    @app.delete("/api/v1/queue/{entry}", responses=REFUSALS)
    def remove(entry: Text, who: Who) -> dict[str, str]:
        """Take out an entry that waits."""
        allow(service, who, Role.OPERATOR, "take out", acts=True)
        service.queue.remove(entry)
        return {"removed": entry}

    @app.post("/api/v1/queue/{entry}/stop", responses=REFUSALS)
    def stop(entry: Text, who: Who) -> dict[str, str]:
        """Stop what an entry has begun, at any time, also before its run has a name."""
        allow(service, who, Role.OPERATOR, "stop")
        service.acquisitions.stop(service.queue.entry(entry))
        return {"stopped": entry}

    @app.post("/api/v1/queue/go-on", responses=REFUSALS)
    def go_on(who: Who) -> StateNow:
        """Go on with the queue after a hold, a fault or a stop."""
        allow(service, who, Role.OPERATOR, "go on with the queue", acts=True)
        service.queue.go_on()
        return service.state()

    @app.post("/api/v1/runs/{run}/{command}", responses=REFUSALS)
    def tell(run: Text, command: Literal["pause", "go-on", "stop"], who: Who) -> dict[str, Any]:
        """To the run that is being acquired. Any operator may pause and stop, whoever is in control: this never
        harms. `stop` is answered when the lights are off and the arm was told to stop, or with the `trouble`."""
        allow(service, who, Role.OPERATOR, command, acts=command == "go-on")
        return service.acquisitions.tell(run, command)


async def _events(service: Service, request: Request) -> AsyncIterator[str]:
    before, said_s = "", 0.0
    while _session_of(request, service) is not None:
        now = service.newest()
        known = now.model_dump_json(exclude={"t"})
        if known != before or time.monotonic() - said_s > _ALIVE_EVERY_S:
            before, said_s = known, time.monotonic()
            yield f"event: state\ndata: {now.model_dump_json()}\n\n"
        await asyncio.sleep(_EVENT_EVERY_S)


# -- people ---------------------------------------------------------------------------------------------------


def _add_people(app: FastAPI, service: Service) -> None:
    @app.post("/api/v1/control/take", responses=REFUSALS)
    def take(who: Who) -> dict[str, str]:
        """Take control, or ask for it; an engineer, and anybody after five minutes without a sign, takes it."""
        allow(service, who, Role.OPERATOR, "take control")
        return asdict(service.control.take(who))

    @app.post("/api/v1/control/give", responses=REFUSALS)
    def give(asked: Hand, who: Who) -> dict[str, str]:
        """Hand control over to who asked for it, or give it up."""
        allow(service, who, Role.OPERATOR, "give control")
        return asdict(service.control.give(who, asked.to))

    @app.get("/api/v1/accounts", responses=REFUSALS)
    def accounts(who: Who) -> list[dict[str, str]]:
        """All accounts, for engineers."""
        if who.role < Role.ENGINEER:
            raise Refused(403, "accounts: only for engineers")
        return [{"name": one.name, "role": one.role.word} for one in service.accounts.listed()]

    @app.post("/api/v1/accounts", responses=REFUSALS)
    def new_account(asked: NewAccount, who: Who) -> dict[str, str]:
        """A new account."""
        allow(service, who, Role.ENGINEER, "new account")
        account = service.accounts.add(asked.name, asked.password, Role.of(asked.role))
        return {"name": account.name, "role": account.role.word}

    @app.delete("/api/v1/accounts/{name}", responses=REFUSALS)
    def no_account(name: Text, who: Who) -> dict[str, str]:
        """Take an account away, and end its sessions."""
        allow(service, who, Role.ENGINEER, "remove account")
        service.accounts.remove(name)
        service.sessions.end_of(name)
        return {"removed": name}

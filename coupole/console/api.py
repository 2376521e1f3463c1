"""The console's HTTP interface, version 1: what it tells, what may be asked of it, and by whom."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import Depends, FastAPI, HTTPException, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

import coupole
from coupole.console.accounts import Account, Accounts, Role, same
from coupole.console.acquisitions import Acquisitions
from coupole.console.audit import Audit
from coupole.console.plan_queue import Entry, PlanQueue
from coupole.console.sessions import Control, Session, Sessions
from coupole.errors import CoupoleError, InputError

COOKIE = "coupole_session"
_EVENT_EVERY_S, _ALIVE_EVERY_S = 0.2, 15.0
_LOOPBACK = ("127.0.0.1", "::1")
_SIGN_IN = Path(__file__).parent / "sign_in.html"
_POLICY = "default-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
Text = Annotated[str, Field(max_length=2000)]


class Asked(BaseModel):
    """Unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class SignIn(Asked):
    """A name and a password, or the token of the first start."""

    name: Text = ""
    """Of an account."""
    password: Text = ""
    """Of the account."""
    token: Text = ""
    """Printed at the first start; an engineer's, once, until there is an account."""


class NewEntry(Asked):
    """A plan, or a hold."""

    plan: Text = ""
    """File of the plan, relative to the folder of plans."""
    hold: Text = ""
    """What is to be done before the queue goes on."""


class NewAccount(Asked):
    """Of a person."""

    name: Text
    """With which they sign in."""
    password: Text
    """With at least ten characters."""
    role: Literal["observer", "operator", "engineer"]
    """What they may do."""


class Hand(Asked):
    """Control, given to who asked for it."""

    to: Text = ""
    """Who; empty: nobody."""


class StateNow(BaseModel):
    """The cell at this moment."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    state: Literal["idle", "starting", "running", "pausing", "paused", "stopping", "halted"]
    """`halted`: the queue waits for a person; `starting`: a plan is checked, and devices are opened."""
    rig: str
    """Name of the rig."""
    simulated: bool
    """No real light, no real arm."""
    run: str | None
    """Name of the run that is being acquired."""
    view: str | None
    """View that is being acquired."""
    proven: int
    """Frames of the run that are proven."""
    frames: int
    """Frames of the run."""
    dose: float
    """Light of the run on the object, in lux hours."""
    left_s: float | None
    """Expected until the run is complete."""
    halted: str
    """Why the queue waits for a person; empty if it does not."""
    arm_fault: str
    """The fault of the arm that stands until a person confirms; empty if there is none."""
    devices: dict[str, Any]
    """Identities of the devices of the run."""
    queue: list[Entry]
    """All entries, in their order."""
    in_control: str
    """Who may act; empty: any operator."""
    asked_by: str
    """Who asks for control."""


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
    read_plan: Callable[[str], Path]
    """The file of a plan of this cell that can be run. Raises InputError."""
    origins: frozenset[str]
    """Of this service's own pages."""
    first_token: list[str]
    """Of the first start; empty once it is used."""
    command_line: Session
    """Of the service's own user, on this machine."""


class _Refused(HTTPException):
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
    or twice."""

    @app.middleware("http")
    async def check(request: Request, call_next: Callable[[Request], Any]) -> Response:
        hosts = {origin.partition("://")[2] for origin in service.origins}
        if not _is_command_line(request) and request.headers.get("host", "") not in hosts:
            return _no(400, "expected this console's own address as host")
        origin = request.headers.get("origin")
        if origin is not None and origin not in service.origins:
            return _no(403, "asked by the page of another site")
        session = _session_of(request, service)
        request.state.session = session
        public = request.url.path in ("/", "/api/v1/sign-in")
        if session is None and not public:
            return _no(401, "sign in first")
        if request.method not in ("GET", "HEAD") and session is not None and not public:
            ambient = not _is_command_line(request) and not _bearer(request)
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


def _is_command_line(request: Request) -> bool:
    """By the service's Unix socket, at which only processes of its own user are heard."""
    server = request.scope.get("server")
    return server is not None and server[1] is None


def _bearer(request: Request) -> str:
    kind, _, secret = request.headers.get("authorization", "").partition(" ")
    return secret if kind == "Bearer" else ""


def _session_of(request: Request, service: Service) -> Session | None:
    if _is_command_line(request):
        return service.command_line
    secret = _bearer(request) or request.cookies.get(COOKIE, "")
    return service.sessions.of(secret) if secret else None


def _account(request: Request) -> Account:
    """Whose session it is; from another machine everybody is an observer."""
    session: Session = request.state.session
    account = session.account
    if _is_command_line(request) or (request.client and request.client.host in _LOOPBACK):
        return account
    return replace(account, role=min(account.role, Role.OBSERVER))


Who = Annotated[Account, Depends(_account)]


def _allow(service: Service, who: Account, role: Role, action: str, *, acts: bool = False, **what: str) -> None:
    """Log what somebody is about to do. Raises _Refused if their role or who is in control forbids it."""
    if who.role < role:
        service.audit.note(who.name, action, "refused: role", **what)
        raise _Refused(403, f"{action}: only for {role.word}s; {who.name} is {who.role.word}")
    if acts and not service.control.act(who):
        service.audit.note(who.name, action, "refused: not in control", **what)
        raise _Refused(409, f"{action}: {service.control.now.name} is in control; ask for it first")
    service.audit.note(who.name, action, "allowed", **what)


# -- signing in -----------------------------------------------------------------------------------------------


def _add_sign_in(app: FastAPI, service: Service) -> None:
    page = _SIGN_IN.read_text(encoding="utf-8")

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    def front() -> HTMLResponse:
        return HTMLResponse(page, headers={"Content-Security-Policy": _POLICY})

    @app.post("/api/v1/sign-in", responses={401: {"description": "Wrong, or tried too often."}})
    def sign_in(asked: SignIn, request: Request, response: Response) -> dict[str, str]:
        """Begin a session: a cookie for browsers, and for scripts the same in `session`, to be sent as
        `Authorization: Bearer`."""
        account = service.accounts.sign_in(asked.name, asked.password) if asked.name else None
        if asked.token and service.first_token and same(asked.token, service.first_token[0]):
            service.first_token.clear()
            account = Account("first engineer", Role.ENGINEER)
        service.audit.note(asked.name or "token", "sign in", "allowed" if account else "refused")
        if account is None:
            raise _Refused(401, "name or password are wrong, or were wrong too often: try again in a minute")
        secret = service.sessions.begin(account)
        safe = request.url.scheme == "https"
        response.set_cookie(COOKIE, secret, httponly=True, samesite="strict", secure=safe)
        return {"name": account.name, "role": account.role.word, "session": secret}

    @app.post("/api/v1/sign-out")
    def sign_out(who: Who, request: Request, response: Response) -> dict[str, str]:
        """End this session."""
        service.sessions.end(_bearer(request) or request.cookies.get(COOKIE, ""))
        service.audit.note(who.name, "sign out", "allowed")
        response.delete_cookie(COOKIE)
        return {"name": who.name}

    @app.get("/api/v1/token")
    def token(request: Request) -> dict[str, str]:
        """For the next request that changes something, in its header X-Coupole-Token."""
        return {"token": service.sessions.token(request.state.session)}


# -- the cell -------------------------------------------------------------------------------------------------

_REFUSALS: dict[int | str, dict[str, Any]] = {
    403: {"description": "Not for this role, or without a fresh token."},
    409: {"description": "Somebody else is in control, or the cell cannot."},
}


def _add_cell(app: FastAPI, service: Service) -> None:
    @app.get("/api/v1/state")
    def state() -> StateNow:
        """The cell at this moment."""
        return service.state()

    @app.get("/api/v1/events", response_class=StreamingResponse)
    async def events() -> StreamingResponse:
        """The state whenever it has changed, as an event stream (`event: state`)."""
        return StreamingResponse(_events(service), media_type="text/event-stream")

    @app.post("/api/v1/queue", responses=_REFUSALS)
    def add(asked: NewEntry, who: Who) -> Entry:
        """Enter a plan or a hold. A plan is read first; wrong ones are refused with all their problems."""
        if bool(asked.plan) == bool(asked.hold):
            raise InputError("expected either `plan` or `hold`")
        _allow(service, who, Role.OPERATOR, "queue", acts=True, plan=asked.plan, hold=asked.hold)
        if asked.hold:
            return service.queue.add(who.name, hold=asked.hold)
        return service.queue.add(who.name, plan=str(service.read_plan(asked.plan)))

    @app.delete("/api/v1/queue/{entry}", responses=_REFUSALS)
    def remove(entry: Text, who: Who) -> dict[str, str]:
        """Take out an entry that waits."""
        _allow(service, who, Role.OPERATOR, "take out", acts=True, entry=entry)
        service.queue.remove(entry)
        return {"removed": entry}

    @app.post("/api/v1/queue/go-on", responses=_REFUSALS)
    def go_on(who: Who) -> StateNow:
        """Go on with the queue after a hold, a fault or a stop."""
        _allow(service, who, Role.OPERATOR, "go on with the queue", acts=True)
        service.queue.go_on()
        return service.state()

    @app.post("/api/v1/runs/{run}/{command}", responses=_REFUSALS)
    def tell(run: Text, command: Literal["pause", "go-on", "stop"], who: Who) -> dict[str, Any]:
        """To the run that is being acquired. Any operator may pause and stop, whoever is in control: this never
        harms. `stop` is answered when the lights were switched off and the arm was told to stop."""
        _allow(service, who, Role.OPERATOR, command, acts=command == "go-on", run=run)
        return service.acquisitions.tell(run, command)


async def _events(service: Service) -> AsyncIterator[str]:
    before, quiet_s = "", 0.0
    while True:
        now = json.dumps(service.state().model_dump())
        if now != before:
            before, quiet_s = now, 0.0
            yield f"event: state\ndata: {now}\n\n"
        elif quiet_s > _ALIVE_EVERY_S:
            quiet_s = 0.0
            yield ": alive\n\n"
        await asyncio.sleep(_EVENT_EVERY_S)
        quiet_s += _EVENT_EVERY_S


# -- people ---------------------------------------------------------------------------------------------------


def _add_people(app: FastAPI, service: Service) -> None:
    @app.post("/api/v1/control/take", responses=_REFUSALS)
    def take(who: Who) -> dict[str, str]:
        """Take control, or ask for it; an engineer, and anybody after five minutes without a sign, takes it."""
        _allow(service, who, Role.OPERATOR, "take control")
        return asdict(service.control.take(who))

    @app.post("/api/v1/control/give", responses=_REFUSALS)
    def give(asked: Hand, who: Who) -> dict[str, str]:
        """Hand control over to who asked for it, or give it up."""
        _allow(service, who, Role.OPERATOR, "give control", to=asked.to)
        return asdict(service.control.give(who, asked.to))

    @app.get("/api/v1/accounts", responses=_REFUSALS)
    def accounts(who: Who) -> list[dict[str, str]]:
        """All accounts, for engineers."""
        if who.role < Role.ENGINEER:
            raise _Refused(403, "accounts: only for engineers")
        return [{"name": one.name, "role": one.role.word} for one in service.accounts.listed()]

    @app.post("/api/v1/accounts", responses=_REFUSALS)
    def new_account(asked: NewAccount, who: Who) -> dict[str, str]:
        """A new account."""
        _allow(service, who, Role.ENGINEER, "new account", account=f"{asked.name} ({asked.role})")
        account = service.accounts.add(asked.name, asked.password, Role.of(asked.role))
        return {"name": account.name, "role": account.role.word}

    @app.delete("/api/v1/accounts/{name}", responses=_REFUSALS)
    def no_account(name: Text, who: Who) -> dict[str, str]:
        """Take an account away, and end its sessions."""
        _allow(service, who, Role.ENGINEER, "remove account", account=name)
        service.accounts.remove(name)
        service.sessions.end_of(name)
        return {"removed": name}

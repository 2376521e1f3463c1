"""The console's HTTP interface, version 1: its answers, its requests, and the rights that they need."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from dataclasses import asdict
from functools import partial
from typing import Any, Literal

from anyio import to_thread
from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse, StreamingResponse

import coupole
from coupole.console.people.accounts import Role
from coupole.console.people.asking import REFUSALS, Who
from coupole.console.people.guard import (
    bearer_of,
    guard,
    is_command_line,
    is_of_this_machine,
    session_of,
    sign_in_page,
    why_unwanted,
)
from coupole.console.people.permission import NotAllowed, allow
from coupole.console.plans.plan_queue import Entry
from coupole.console.routes.api_at_the_cell import add_routes_at_the_cell
from coupole.console.routes.bench_routes import add_bench_routes
from coupole.console.routes.messages import Hand, NewAccount, NewEntry, SignIn, StateNow, Text
from coupole.console.routes.object_routes import add_object_routes
from coupole.console.routes.plan_routes import add_plan_routes
from coupole.console.routes.run_routes import add_routes_so_far, add_run_routes
from coupole.console.service_parts import Service

_EVENT_EVERY_S, _ALIVE_EVERY_S = 0.2, 1.0


def make_app(service: Service) -> FastAPI:
    """The interface, and its schema at /openapi.json."""
    app = FastAPI(title="Coupole console", version=coupole.__version__, docs_url=None, redoc_url=None)
    guard(app, service)
    _add_sign_in(app, service)
    _add_cell(app, service)
    add_run_routes(app, service)
    add_routes_so_far(app, service)
    _add_people(app, service)
    add_plan_routes(app, service)
    add_object_routes(app, service)
    add_routes_at_the_cell(app, service)
    add_bench_routes(app, service)
    return app


# -- signing in -----------------------------------------------------------------------------------------------


def _add_sign_in(app: FastAPI, service: Service) -> None:
    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    def front(request: Request) -> Response:
        if request.state.session is None:
            return sign_in_page()
        return RedirectResponse("/run", 303)

    @app.post(
        "/api/v1/sign-in", responses={401: {"description": "Name or password is wrong, or was tried too often."}}
    )
    def sign_in(credentials: SignIn, request: Request, response: Response) -> dict[str, str]:
        """Begin a session. Browsers get a cookie; scripts get `session`, to be sent as `Authorization: Bearer`."""
        here = is_of_this_machine(request)
        if credentials.name:
            account = service.accounts.sign_in(credentials.name, credentials.password, here=here)
        else:
            account = service.accounts.sign_in_first(credentials.token) if here else None
        if account is None:
            raise NotAllowed(401, "name or password is wrong, or was wrong too often: try again in a minute")
        secret = service.sessions.begin(account, script=credentials.script)
        answer = {"name": account.name, "role": account.role.word}
        if credentials.script:
            return {**answer, "session": secret}
        safe = request.url.scheme == "https"
        response.set_cookie(service.cookie, secret, httponly=True, samesite="strict", secure=safe)
        return answer

    @app.post("/api/v1/sign-out")
    def sign_out(person: Who, request: Request, response: Response) -> dict[str, str]:
        """End this session."""
        service.sessions.end(bearer_of(request) or request.cookies.get(service.cookie, ""))
        response.delete_cookie(service.cookie)
        return {"name": person.name}

    @app.get("/api/v1/token")
    def token(request: Request) -> dict[str, str]:
        """Return a token for the next request that changes something, to be sent in its header X-Coupole-Token."""
        return {"token": service.sessions.token(request.state.session)}


# -- the cell -------------------------------------------------------------------------------------------------


def _add_cell(app: FastAPI, service: Service) -> None:
    @app.get("/api/v1/state")
    def state() -> StateNow:
        """Return the present state of the cell."""
        return service.state()

    @app.get("/api/v1/events", response_class=StreamingResponse)
    async def events(request: Request) -> StreamingResponse:
        """Send the state after every change, and every second, as an event stream (`event: state`), until the
        session is over."""
        return StreamingResponse(_events(service, request), media_type="text/event-stream")

    @app.post("/api/v1/queue", responses=REFUSALS)
    async def add(new_entry: NewEntry, person: Who, request: Request) -> Entry:
        """Enter a plan, a run to be resumed, or a hold. The answer comes after the preflight. An entry is refused
        with all its problems if it cannot be run, or if it cannot be run after the entries before it."""
        allow(service, person, Role.OPERATOR, "queue", acts=True)
        request.state.about = new_entry.plan or new_entry.resume or new_entry.hold
        here = is_command_line(request)

        def may_still() -> None:
            if session_of(request, service) is None:
                raise NotAllowed(401, "the session is over: sign in again")
            if refusal := why_unwanted(request, service):
                raise NotAllowed(409, refusal)
            allow(service, person, Role.OPERATOR, "queue", acts=True)

        enter = partial(service.entering.enter, new_entry, person.name, by_command_line=here, may_still=may_still)
        quick = new_entry.now or bool(new_entry.hold)
        limiter = None if quick else service.entering.one_at_a_time
        return await to_thread.run_sync(enter, limiter=limiter, abandon_on_cancel=True)

    @app.delete("/api/v1/queue/{entry}", responses=REFUSALS)
    def remove(entry: Text, person: Who) -> dict[str, str]:
        """Remove a waiting entry."""
        allow(service, person, Role.OPERATOR, "take out", acts=True)
        service.queue.remove(entry)
        return {"removed": entry}

    @app.post("/api/v1/queue/{entry}/stop", responses=REFUSALS)
    def stop(entry: Text, person: Who) -> dict[str, str]:
        """Stop the process of an entry, at any time, also before its run has a name."""
        allow(service, person, Role.OPERATOR, "stop")
        service.acquisitions.stop(service.queue.entry(entry))
        return {"stopped": entry}

    @app.post("/api/v1/queue/go-on", responses=REFUSALS)
    def go_on(person: Who) -> StateNow:
        """Go on with the queue after a hold, a fault or a stop."""
        allow(service, person, Role.OPERATOR, "go on with the queue", acts=True)
        service.queue.go_on()
        return service.state()

    @app.post("/api/v1/runs/{run}/{command}", responses=REFUSALS)
    def tell(run: Text, command: Literal["pause", "go-on", "stop"], person: Who) -> dict[str, Any]:
        """Send a command to the run that is being acquired. Any operator may pause and stop, even if another
        person is in control, because this never harms. The answer to `stop` comes when the lights are off and the
        arm was told to stop, or it contains the `trouble`."""
        allow(service, person, Role.OPERATOR, command, acts=command == "go-on")
        return service.acquisitions.tell(run, command)


async def _events(service: Service, request: Request) -> AsyncIterator[str]:
    before, said_s = "", 0.0
    while session_of(request, service, counts_as_use=False) is not None:
        now = service.newest()
        state_text = now.model_dump_json(exclude={"t"})
        if state_text != before or time.monotonic() - said_s > _ALIVE_EVERY_S:
            before, said_s = state_text, time.monotonic()
            yield f"event: state\ndata: {now.model_dump_json()}\n\n"
        await asyncio.sleep(_EVENT_EVERY_S)


# -- people ---------------------------------------------------------------------------------------------------


def _add_people(app: FastAPI, service: Service) -> None:
    @app.post("/api/v1/control/take", responses=REFUSALS)
    def take(person: Who) -> dict[str, str]:
        """Take control, or ask for it. An engineer gets control at once, and any operator does if the person in
        control has done nothing for five minutes."""
        allow(service, person, Role.OPERATOR, "take control")
        return asdict(service.control.take(person))

    @app.post("/api/v1/control/give", responses=REFUSALS)
    def give(handover: Hand, person: Who) -> dict[str, str]:
        """Hand control over to the person who asked for it, or give it up."""
        allow(service, person, Role.OPERATOR, "give control")
        return asdict(service.control.give(person, handover.to))

    @app.get("/api/v1/accounts", responses=REFUSALS)
    def accounts(person: Who) -> list[dict[str, str]]:
        """Return all accounts; for engineers."""
        if person.role < Role.ENGINEER:
            raise NotAllowed(403, "accounts: only for engineers")
        return [{"name": account.name, "role": account.role.word} for account in service.accounts.all_accounts()]

    @app.post("/api/v1/accounts", responses=REFUSALS)
    def new_account(request: NewAccount, person: Who) -> dict[str, str]:
        """Add an account."""
        allow(service, person, Role.ENGINEER, "new account")
        account = service.accounts.add(request.name, request.password, Role.of(request.role))
        return {"name": account.name, "role": account.role.word}

    @app.delete("/api/v1/accounts/{name}", responses=REFUSALS)
    def no_account(name: Text, person: Who) -> dict[str, str]:
        """Remove an account; its sessions end."""
        allow(service, person, Role.ENGINEER, "remove account")
        service.accounts.remove(name)
        return {"removed": name}

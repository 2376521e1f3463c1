"""The bench's pictures, and the connection by which a button at the console keeps the arm in motion."""

from __future__ import annotations

import contextlib
import re
import secrets
from typing import Any

from anyio import to_thread
from fastapi import FastAPI, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse

from coupole.console.people.accounts import Account, Role
from coupole.console.people.asking import REFUSALS, Who
from coupole.console.people.guard import account_here, address_of, is_of_this_machine, session_of
from coupole.console.people.permission import NotAllowed, allow
from coupole.console.people.still_wanted import HELD_STOOD_STILL_S
from coupole.console.routes.messages import Permission, Permitted, Text
from coupole.console.service_parts import Service
from coupole.errors import CoupoleError, InputError
from coupole.intake.plain_data import json_of

HOLD = "/api/v1/bench/hold"
_PRESSED = {"axis", "direction", "share"}


def add_bench_routes(app: FastAPI, service: Service) -> None:
    """Add the routes to a console's app."""

    @app.get("/api/v1/bench")
    def bench() -> dict[str, Any]:
        """Return `phase` (closed, opening, open, closing), `plan`, `closed_because`, and the bench's `state`."""
        keeper = service.bench
        keeper.looked_at()
        return {
            "phase": keeper.phase,
            "plan": keeper.plan,
            "closed_because": keeper.closed_because,
            "state": keeper.state,
        }

    @app.get("/api/v1/bench/pictures/{name}", response_class=Response)
    def picture(name: Text) -> FileResponse:
        """Return one of the last pictures as JPEG (`7.jpg`), or `loupe.png`."""
        if not re.fullmatch(r"[0-9]{1,9}\.jpg|loupe\.png", name):
            raise InputError("expected a number and .jpg, or loupe.png")
        path = service.bench.pictures / name
        if not path.is_file():
            raise InputError(f"{name}: this picture is gone")
        return FileResponse(path)

    @app.post("/api/v1/bench/permission", responses=REFUSALS)
    def permit(question: Permission, person: Who, request: Request) -> Permitted:
        """Tell a command whether it may act with the devices that the bench holds: nobody else is in control. The
        command then asks the bench itself, which ends the motion when that process ends."""
        request.state.about = question.action
        count = service.control.taken_count
        allow(service, person, Role.OPERATOR, question.action, acts=True)
        return Permitted(in_control=service.control.now.name, may_act=True, taken_count=count)

    @app.get("/api/v1/bench/permission", responses=REFUSALS)
    def still_permitted(person: Who, taken_count: int) -> Permitted:
        """Tell a command that drives the arm whether this person may still do so. It stops the arm if not.
        `taken_count` is the count of the permission: another person who came into control since then, even for a
        moment, ends it."""
        control, count = service.control, service.control.taken_count
        taker = control.taken_since(taken_count, person.name)
        may_act = not taker and control.may_act(person)
        return Permitted(in_control=taker or control.now.name, may_act=may_act, taken_count=count)

    @app.websocket(HOLD)
    async def hold(socket: WebSocket) -> None:
        """Move an axis while a button is held. The page sends `{axis, direction, share}`. A renewal also has the
        word of the newest answer (`renew`), so it cannot be sent before this answer has come. Renewals that wait
        in the network, or are sent in advance, have no effect. When the button is released or the connection is
        lost, the motion ends.
        """
        await socket.accept()
        await _Hold(service, socket).serve()


class _Hold:
    """One button, from its press to its release."""

    def __init__(self, service: Service, socket: WebSocket) -> None:
        self._service, self._socket = service, socket
        self._number: int | None = None
        self._asked: dict[str, Any] = {}
        self._next_word = ""
        """Word that the next renewal must have."""

    async def serve(self) -> None:
        outcome, is_moving = "the button was released", False
        try:
            while True:
                jog_request = json_of(await self._socket.receive_text(), "request")
                work = await to_thread.run_sync(self._press_or_renew, jog_request)
                if not is_moving:
                    is_moving = True
                    self._note(f"begins to move {_words(jog_request)}", 200)
                self._next_word = secrets.token_hex(8)
                await self._socket.send_json({"state": work["state"], "renew": self._next_word})
                if work["state"] != "running":
                    outcome = str(work.get("ended") or work["why"] or work["state"])
                    break
        except (WebSocketDisconnect, KeyError):
            outcome = await to_thread.run_sync(self._let_go)
        except (NotAllowed, CoupoleError) as error:
            outcome = str(error)
            await to_thread.run_sync(self._let_go)
        self._note(f"ends: {outcome}" if is_moving else f"is refused: {outcome}", 200 if is_moving else 409)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await self._socket.send_json({"ended": outcome})
            await self._socket.close()

    def _press_or_renew(self, request: Any) -> dict[str, Any]:
        """Begin or prolong the motion. Raises NotAllowed, InputError."""
        is_press = self._number is None
        keys = _PRESSED if is_press else _PRESSED | {"renew"}
        if not isinstance(request, dict) or set(request) != keys:
            raise InputError(f"expected {', '.join(sorted(keys))}")
        if not is_press:
            self._refuse_untimely(request.pop("renew"), request)
        if refusal := self._service.loop_watch.refusal(HELD_STOOD_STILL_S):
            raise NotAllowed(409, refusal)
        allow(self._service, self._account(), Role.OPERATOR, "move by hand", acts=True)
        goes_on = {} if is_press else {"hold": self._number}
        self._asked = {**request, "from": address_of(self._socket)}
        work = self._service.bench.ask("jog", **self._asked, **goes_on)
        self._number = int(work["hold"])
        return work

    def _refuse_untimely(self, word: Any, request: dict[str, Any]) -> None:
        """Raise InputError unless a renewal was sent after the newest answer, and is for the same motion."""
        if word != self._next_word:
            raise InputError("renew: expected the word of the newest answer; a renewal sent before it is void")
        if any(request[key] != self._asked[key] for key in ("axis", "direction")):
            raise InputError(
                "expected the axis and the direction with which the button was pressed; a renewal cannot change "
                "them"
            )

    def _let_go(self) -> str:
        """End the motion at once: a command in the opposite direction ends it."""
        if self._number is None:
            return "the button was released"
        reversed_jog = {**self._asked, "direction": -self._asked["direction"], "hold": self._number}
        with contextlib.suppress(CoupoleError):
            self._service.bench.ask("jog", **reversed_jog)
        return "the button was released, or the connection was lost"

    def _account(self) -> Account:
        session = session_of(self._socket, self._service)
        if session is None:
            raise NotAllowed(401, "the session is over: sign in again")
        return account_here(session.account, of_this_machine=is_of_this_machine(self._socket))

    def _note(self, words: str, status: int) -> None:
        session = session_of(self._socket, self._service)
        name = session.account.name if session else ""
        self._service.audit.note(name, f"hold {words}", status, address_of(self._socket))


def _words(request: dict[str, Any]) -> str:
    return f"{request['axis']} {'+' if request['direction'] > 0 else '-'}"

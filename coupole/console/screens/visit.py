"""One visit: a person who has a screen open, what they may do, and what the screen is to follow."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, ParamSpec, TypeVar

from fastapi import Request
from nicegui import Client, run, ui

from coupole.console.accounts import Account, Role
from coupole.console.guard import account_here, address_of, is_of_this_machine
from coupole.console.messages import NewEntry, StateNow
from coupole.console.permission import NotAllowed, allow
from coupole.console.service_parts import Service
from coupole.errors import CoupoleError, InputError

T = TypeVar("T")
P = ParamSpec("P")
NEWS_EVERY_S = 0.3


class Visit:
    """Passed to whoever builds a screen."""

    def __init__(self, service: Service, request: Request) -> None:
        self.service = service
        self._secret = request.cookies.get(service.cookie, "")
        self._here, self.address = is_of_this_machine(request), address_of(request)
        """Where the browser is, as this machine sees it."""
        self._client: Client = ui.context.client
        self._followers: list[Callable[[StateNow], object]] = []

    @property
    def account(self) -> Account | None:
        """None when the session is over."""
        session = self.service.sessions.of(self._secret, script=False)
        return account_here(session.account, of_this_machine=self._here) if session else None

    @property
    def may_act(self) -> bool:
        """An operator on this machine."""
        account = self.account
        return account is not None and account.role >= Role.OPERATOR

    @property
    def is_engineer(self) -> bool:
        account = self.account
        return account is not None and account.role >= Role.ENGINEER

    @property
    def now(self) -> StateNow:
        return self.service.newest()

    def sign_out(self) -> None:
        """End the session."""
        self.service.sessions.end(self._secret)

    def follow(self, show: Callable[[StateNow], object]) -> None:
        """Call `show` now, and with each news of the cell, as long as the screen is open."""
        show(self.now)
        self._followers.append(show)

    def watch(self) -> None:
        """Begin to tell the followers; called once the screen is built."""
        before = ""

        def tell() -> None:
            nonlocal before
            if self.account is None:
                ui.navigate.to("/")
                return
            now = self.now
            known = now.model_dump_json(exclude={"t"})
            if known == before:
                return
            before = known
            for show in self._followers:
                show(now)

        ui.timer(NEWS_EVERY_S, tell)

    async def act(
        self,
        action: str,
        do: Callable[[], T],
        *,
        role: Role = Role.OPERATOR,
        acts: bool = True,
        done: str = "",
    ) -> T | None:
        """Do something in a thread, if this person may; it is logged with its outcome, and the screen says why it
        was refused. `acts`: only for who is in control. None if it was refused or failed."""
        account, status = self.account, 200
        try:
            if account is None:
                raise NotAllowed(401, "the session is over: sign in again")
            allow(self.service, account, role, action, acts=acts)
            found = await in_thread(do)
        except NotAllowed as refusal:
            status = refusal.status
            self.say(str(refusal), bad=True)
            return None
        except CoupoleError as error:
            status = 422 if isinstance(error, InputError) else 409
            self.say(str(error), bad=True)
            return None
        finally:
            self.service.audit.note(account.name if account else "", f"screen: {action}", status, self.address)
        if done:
            self.say(done)
        return found

    @property
    def is_watched(self) -> bool:
        """Whether the page is open in a browser at this moment."""
        return self._client.has_socket_connection

    def say(self, words: str, *, bad: bool = False) -> None:
        """A word at the screen's foot; a bad one stays until it is closed."""
        if self._client.has_socket_connection:
            with self._client:
                kind: Any = "negative" if bad else "positive"
                ui.notify(words, type=kind, multi_line=True, close_button="close", timeout=0 if bad else 4000)


async def enter(visit: Visit, asked: NewEntry, words: str) -> bool:
    """Put something in the queue; preflight is made first. Whether it is in."""
    service, account = visit.service, visit.account
    if not asked.hold:
        visit.say(f"{words}: preflight is made, then it is in the queue")
    async with service.entering.one_at_a_time:
        entered = await visit.act(
            f"queue {words}",
            lambda: service.entering.enter(asked, account.name if account else "", by_command_line=False),
            done=f"{words} is in the queue",
        )
    return entered is not None


async def in_thread(do: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Its result; the screens go on meanwhile."""
    found: T = await run.io_bound(do, *args, **kwargs)  # type: ignore[assignment]  # None only while all ends
    return found


def in_background(work: Callable[[], Awaitable[object]]) -> None:
    """Begin something that a screen does not wait for."""
    task = asyncio.ensure_future(work())
    _UNDER_WAY.add(task)
    task.add_done_callback(_UNDER_WAY.discard)


_UNDER_WAY: set[asyncio.Future[Any]] = set()

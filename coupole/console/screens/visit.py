"""One visit: a person with an open screen, their rights, and the news that the screen follows."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

from fastapi import Request
from nicegui import Client, app, background_tasks, ui

from coupole.console.people.accounts import Account, Role
from coupole.console.people.guard import account_here, address_of, is_of_this_machine
from coupole.console.people.permission import NotAllowed, allow
from coupole.console.plans.plan_queue import Entry
from coupole.console.routes.messages import NewEntry, StateNow
from coupole.console.service_parts import Service
from coupole.errors import CoupoleError, InputError

T = TypeVar("T")
P = ParamSpec("P")
NEWS_EVERY_S = 0.3


class Visit:
    """Argument of the functions that build a screen."""

    def __init__(self, service: Service, request: Request) -> None:
        self.service = service
        self._secret = request.cookies.get(service.cookie, "")
        self._here, self.address = is_of_this_machine(request), address_of(request)
        """True if the browser is on this machine; address of the browser as this machine sees it."""
        self._client: Client = ui.context.client
        self._followers: list[Callable[[StateNow], object]] = []

    @property
    def account(self) -> Account | None:
        """Account of the person; None when the session is over."""
        session = self.service.sessions.of(self._secret, script=False, counts_as_use=False)
        return account_here(session.account, of_this_machine=self._here) if session else None

    @property
    def may_act(self) -> bool:
        """True for an operator on this machine."""
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
        """Call `show` now, and at each change of the cell's state, while the screen is open."""
        show(self.now)
        self._followers.append(show)

    def watch(self) -> None:
        """Begin to call the followers; called once when the screen is built.

        The visit has its own loop. The library's timers stop if the machine's clock is set back, and then a
        person would take an old state for a new one.
        """
        before, over = "", False

        def tell() -> None:
            nonlocal before
            nonlocal over
            if self.account is None:
                if over:
                    self._client.delete()  # the message failed; this follower is not called any more
                over = True
                ui.navigate.to("/")
                return
            now = self.now
            state_text = now.model_dump_json(exclude={"t"})
            if state_text == before:
                return
            before = state_text
            for show in self._followers:
                try:
                    show(now)
                except Exception as error:  # noqa: BLE001  the others are told all the same
                    app.handle_exception(error)

        async def tell_always() -> None:
            await self._client.connected()
            while not self._client.is_deleted:
                with self._client:
                    tell()
                await asyncio.sleep(NEWS_EVERY_S)

        background_tasks.create(tell_always(), name="news for a screen")

    async def act(
        self,
        action: str,
        do: Callable[[], T],
        *,
        role: Role = Role.OPERATOR,
        acts: bool = True,
        done_text: str = "",
        urgent: bool = False,
    ) -> T | None:
        """Do something in a thread, if this person may; return None if it was refused or failed.

        It is logged with its outcome, and the screen shows a refusal. `acts`: only the person in control may do
        it. `urgent`: it stops something, and therefore waits for no other action.
        """
        account, status = self.account, 200
        try:
            self.service.sessions.of(self._secret, script=False)
            self.require(action, role, acts=acts)
            answer = await _in(_URGENT if urgent else _ACTING, do)
        except NotAllowed as refusal:
            status = refusal.status
            self.say(str(refusal), bad=True)
            return None
        except CoupoleError as error:
            status = 422 if isinstance(error, InputError) else 409
            self.say(str(error), bad=True)
            return None
        except Exception as error:
            status = 500
            self.say(f"{action}: {type(error).__name__}: {error}", bad=True)
            raise
        finally:
            line = (account.name if account else "", f"screen: {action}", status, self.address)
            _LOGGING.submit(self.service.audit.note, *line)
        if done_text:
            self.say(done_text)
        return answer

    def require(self, action: str, role: Role = Role.OPERATOR, *, acts: bool = True) -> None:
        """Raise NotAllowed if this person may not do something now."""
        account = self.account
        if account is None:
            raise NotAllowed(401, "the session is over: sign in again")
        if acts and (refusal := self.service.loop_watch.refusal()):
            raise NotAllowed(409, f"{action}: {refusal}")
        allow(self.service, account, role, action, acts=acts)

    @property
    def is_watched(self) -> bool:
        """Tell whether the page is now open in a browser."""
        return self._client.has_socket_connection

    def say(self, words: str, *, bad: bool = False) -> None:
        """Show a message at the foot of the screen; a message of trouble stays until it is closed."""
        if self._client.has_socket_connection:
            with self._client:
                kind: Any = "negative" if bad else "positive"
                ui.notify(words, type=kind, multi_line=True, close_button="close", timeout=0 if bad else 4000)


async def enter(visit: Visit, request: NewEntry, words: str) -> bool:
    """Enter something in the queue, after its preflight; return True if it was entered."""
    entering, account = visit.service.entering, visit.account
    by = account.name if account else ""

    def do() -> Entry:
        return entering.enter(request, by, by_command_line=False, may_still=lambda: visit.require("queue"))

    if request.hold:
        return await visit.act(f"queue {words}", do, done_text=f"{words} is in the queue") is not None
    visit.say(f"{words}: preflight checks the entry, then it is put into the queue")
    async with entering.one_at_a_time:
        return await visit.act(f"queue {words}", do, done_text=f"{words} is in the queue") is not None


async def in_thread(do: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Return the result of a function that runs in a thread, so that the screens go on."""
    return await _in(_READING, do, *args, **kwargs)


async def in_long_thread(do: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """The same for functions that take minutes; only one of them runs at a time."""
    return await _in(_LONG, do, *args, **kwargs)


async def _in(pool: ThreadPoolExecutor, do: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    return await asyncio.get_running_loop().run_in_executor(pool, functools.partial(do, *args, **kwargs))


_READING, _LONG = ThreadPoolExecutor(8, "reading"), ThreadPoolExecutor(1, "reading for long")
_ACTING, _URGENT = ThreadPoolExecutor(16, "acting"), ThreadPoolExecutor(8, "stopping")
_LOGGING = ThreadPoolExecutor(1, "log")
"""Separate thread pools, so that looking never delays acting, and nothing delays a stop."""


def in_background(work: Callable[[], Awaitable[object]]) -> None:
    """Begin work for which no screen waits."""
    task = asyncio.ensure_future(work())
    _UNDER_WAY.add(task)
    task.add_done_callback(_UNDER_WAY.discard)


_UNDER_WAY: set[asyncio.Future[Any]] = set()

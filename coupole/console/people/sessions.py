"""Sessions of the people who are signed in, and the one who is in control."""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from coupole.console.people.accounts import Account, Role
from coupole.errors import InputError

IDLE_S = 12 * 3600.0
"""Time without use, s, after which a session is over."""
ABSENT_S = 300.0
"""Time without action, s, after which any operator may replace the person in control."""
_MOST_TOKENS = 64


@dataclass
class Session:
    """One browser, or one script, of a person."""

    account: Account
    seen_s: float
    script: bool
    """True for a script: its secret is sent as a bearer token, which no browser adds by itself."""
    tokens: set[str] = field(default_factory=set)
    """Unused tokens; each is valid for one request that changes something."""


class Sessions:
    """All sessions, in memory only: after a restart, everybody signs in again."""

    def __init__(
        self,
        now_s: Callable[[], float] = time.monotonic,
        holds: Callable[[Account], bool] = lambda _: True,
    ) -> None:
        """`holds` tells whether an account is still valid; the session ends when it is not."""
        self._now_s, self._holds, self._lock = now_s, holds, threading.Lock()
        self._by_hash: dict[str, Session] = {}

    def begin(self, account: Account, *, script: bool) -> str:
        """Begin a session; return its secret, which only the browser or script keeps."""
        secret = secrets.token_urlsafe(32)
        now_s = self._now_s()
        with self._lock:
            self._by_hash = {
                key: session for key, session in self._by_hash.items() if now_s - session.seen_s <= IDLE_S
            }
            self._by_hash[_hash(secret)] = Session(account, now_s, script)
        return secret

    def of(self, secret: str, *, script: bool, counts_as_use: bool = True) -> Session | None:
        """Return the session of this kind with this secret, if it is not over. `counts_as_use`: this request
        prolongs it."""
        with self._lock:
            session = self._by_hash.get(_hash(secret))
            if session is None or session.script is not script:
                return None
            if self._now_s() - session.seen_s > IDLE_S or not self._holds(session.account):
                self._by_hash.pop(_hash(secret), None)
                return None
            if counts_as_use:
                session.seen_s = self._now_s()
            return session

    def end(self, secret: str) -> None:
        with self._lock:
            self._by_hash.pop(_hash(secret), None)

    def token(self, session: Session) -> str:
        """Return a new token for one request of this session."""
        token = secrets.token_urlsafe(16)
        with self._lock:
            while len(session.tokens) >= _MOST_TOKENS:
                session.tokens.pop()
            session.tokens.add(token)
        return token

    def spend(self, session: Session, token: str) -> bool:
        """Use up a token. Return True for a token of the session that was not used before."""
        with self._lock:
            is_valid = token in session.tokens
            session.tokens.discard(token)
            return is_valid


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


@dataclass(frozen=True)
class InControl:
    """Name of the person in control, and of the person who asks for control."""

    name: str = ""
    asked_by: str = ""


class Control:
    """Control of the cell. One person at a time is in control, until that person hands control over, releases it,
    or does nothing for some time."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s, self._lock = now_s, threading.Lock()
        self._now, self._acted_s = InControl(), 0.0
        self._taken: list[str] = []
        """Names of the persons who came into control, in this order."""

    @property
    def taken_count(self) -> int:
        """Number of times that somebody came into control."""
        return len(self._taken)

    def taken_since(self, count: int, holder: str) -> str:
        """Return the name of a person other than `holder` who came into control after the first `count` times,
        even if only for a moment; empty if there was none."""
        return next((name for name in self._taken[count:] if name != holder), "")

    @property
    def now(self) -> InControl:
        return self._now

    def may_act(self, account: Account) -> bool:
        """Tell whether nobody else is in control. This changes nothing."""
        return self._now.name in ("", account.name)

    def take(self, account: Account) -> InControl:
        """Take control if nobody has it, if its holder has done nothing for some time, or if this account is an
        engineer's; otherwise ask for it."""
        with self._lock:
            holder = self._now.name
            absent = self._now_s() - self._acted_s > ABSENT_S
            if holder in ("", account.name) or absent or account.role is Role.ENGINEER:
                self._change(InControl(account.name))
            else:
                self._now = replace(self._now, asked_by=account.name)
            return self._now

    def give(self, account: Account, to: str) -> InControl:
        """Hand control over to the person who asked for it, or give it up (`to` is empty). Raises InputError."""
        with self._lock:
            if self._now.name != account.name:
                raise InputError(f"{account.name} is not in control")
            if to and to != self._now.asked_by:
                raise InputError(f"{to} has not asked for control")
            self._change(InControl(to))
            return self._now

    def act(self, account: Account, *, keep: bool = True) -> bool:
        """Tell whether a person may act now: the person in control, or any operator if nobody is in control. That
        operator then takes control, unless `keep` is false."""
        with self._lock:
            if not self.may_act(account):
                return False
            if not keep and not self._now.name:
                return True
            self._change(replace(self._now, name=account.name))
            return True

    def _change(self, now: InControl) -> None:
        if now.name not in ("", self._now.name):
            self._taken.append(now.name)
        self._now, self._acted_s = now, self._now_s()

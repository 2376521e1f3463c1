"""Accounts of the people who may sign in to a cell's console: names, roles and hashed passwords in one file."""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import secrets
import threading
import time
import unicodedata
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any

import argon2

from coupole.errors import InputError, StorageError
from coupole.intake.plain_data import read_json
from coupole.storage.durable import make_folder, write_synced

SHORTEST_PASSWORD, LONGEST_PASSWORD = 10, 200
_NAME = re.compile(r"[^\W_](?:[\w .'-]{0,62}[\w.'-])?", re.UNICODE)
_MOST_FAILURES, _MOST_FROM_ELSEWHERE, _MOST_KEPT, _FORGOTTEN_AFTER_S = 5, 30, 1000, 60.0


class Role(IntEnum):
    """Rights of a person; each role may also do everything that lower roles may do."""

    OBSERVER = 1
    """May look."""
    OPERATOR = 2
    """May run plans."""
    ENGINEER = 3
    """May calibrate, and manages the accounts."""

    @property
    def word(self) -> str:
        return self.name.lower()

    @classmethod
    def of(cls, word: str) -> Role:
        """Return the role of this name. Raises InputError."""
        try:
            return cls[word.upper()]
        except KeyError:
            raise InputError(f"role: expected {', '.join(role.word for role in cls)}; found {word!r}") from None


@dataclass(frozen=True)
class Account:
    """A person."""

    name: str
    role: Role
    key: str = field(default="", compare=False, repr=False)
    """Key that distinguishes this account from a later one of the same name."""


FIRST_ENGINEER = Account("first engineer", Role.ENGINEER)
"""The person who signs in with the token, until an engineer has an account."""


class Accounts:
    """The accounts, in a file that only its owner may read. Passwords are hashed by argon2id with the library's
    parameters (RFC 9106)."""

    def __init__(self, path: Path) -> None:
        """Raises StorageError if the file cannot be read."""
        self._path, self._lock = path, threading.Lock()
        self._hasher = argon2.PasswordHasher()
        self._nobodys_hash = self._hasher.hash(secrets.token_hex())
        self._checking = threading.Lock()
        self._failures: list[tuple[float, bool, str]] = []
        try:
            self._stored: dict[str, dict[str, Any]] = read_json(path) if path.exists() else {}
        except (OSError, InputError) as error:
            raise StorageError(f"{path}: the console's accounts cannot be read: {error}") from error
        self.first_token = "" if _has_engineer(self._stored) else secrets.token_urlsafe(24)
        """Token with which an engineer signs in while no engineer has an account; empty if the token is not
        valid."""

    def all_accounts(self) -> list[Account]:
        """Return all accounts, by name."""
        return [Account(name, Role.of(entry["role"])) for name, entry in sorted(self._stored.items())]

    def holds(self, account: Account) -> bool:
        """Tell whether a signed-in account is still valid: it exists and has this role. The account of the first
        engineer is valid while no engineer has an account."""
        if account == FIRST_ENGINEER:
            return not _has_engineer(self._stored)
        entry = self._stored.get(account.name)
        return entry is not None and entry["role"] == account.role.word and _key(entry) == account.key

    def add(self, name: str, password: str, role: Role) -> Account:
        """Add an account; it is on the disk when this returns. Raises InputError, StorageError."""
        if not _NAME.fullmatch(name):
            raise InputError(
                "name: expected at most 64 letters, digits, spaces, dots, hyphens; a letter first, no space last"
            )
        if name == FIRST_ENGINEER.name:
            raise InputError(f"name: {name} is the name for everybody who signs in with the token")
        if not SHORTEST_PASSWORD <= len(password) <= LONGEST_PASSWORD:
            raise InputError(f"password: expected {SHORTEST_PASSWORD} to {LONGEST_PASSWORD} characters")
        password_hash = self._hasher.hash(password)
        with self._lock:
            if alike := [
                other_name for other_name in self._stored if _visible_form(other_name) == _visible_form(name)
            ]:
                raise InputError(f"name: {alike[0]} already has an account")
            self._keep({**self._stored, name: {"role": role.word, "password": password_hash}})
            if role is Role.ENGINEER:
                self.first_token = ""
        return Account(name, role)

    def change_role(self, name: str, role: Role) -> None:
        """Change the role of an account. Raises InputError if there is no such account, or if it is the last
        engineer's; StorageError."""
        with self._lock:
            if name not in self._stored:
                raise InputError(f"name: {name} has no account")
            accounts = {**self._stored, name: {**self._stored[name], "role": role.word}}
            if _has_engineer(self._stored) and not _has_engineer(accounts):
                raise InputError("name: this is the last engineer; nobody could keep the accounts")
            self._keep(accounts)

    def remove(self, name: str) -> None:
        """Remove an account. Raises InputError if there is no such account, or if it is the last engineer's;
        StorageError."""
        with self._lock:
            if name not in self._stored:
                raise InputError(f"name: {name} has no account")
            remaining_accounts = {
                other_name: entry for other_name, entry in self._stored.items() if other_name != name
            }
            if _has_engineer(self._stored) and not _has_engineer(remaining_accounts):
                raise InputError("name: this is the last engineer; nobody could keep the accounts")
            self._keep(remaining_accounts)

    def sign_in(self, name: str, password: str, *, here: bool) -> Account | None:
        """Return the account with this name and password; None if there is none, and for a minute after five
        failures.

        The check takes equally long for unknown names. Only one password is checked at a time, because hashing is
        expensive by design. Failures from other machines do not block a person who is `here`; thirty of them block
        all other machines.
        """
        with self._checking:
            now_s = time.monotonic()
            recent = [
                failure
                for failure in self._failures
                if now_s - failure[0] < _FORGOTTEN_AFTER_S and failure[1] == here
            ]
            of_name = sum(failed_name == name for _, _, failed_name in recent)
            if of_name >= _MOST_FAILURES or (len(recent) >= _MOST_FROM_ELSEWHERE and not here):
                return None
            entry = self._stored.get(name)
            try:
                self._hasher.verify(
                    entry["password"] if entry else self._nobodys_hash, password[:LONGEST_PASSWORD]
                )
            except (argon2.exceptions.VerificationError, argon2.exceptions.InvalidHashError):
                recent_failures = [
                    failure for failure in self._failures if now_s - failure[0] < _FORGOTTEN_AFTER_S
                ]
                self._failures = [*recent_failures[-_MOST_KEPT:], (now_s, here, name)]
                return None
        return Account(name, Role.of(entry["role"]), _key(entry)) if entry else None

    def sign_in_first(self, token: str) -> Account | None:
        """Return the first engineer's account for the token of a start without an engineer's account; the token is
        valid once."""
        with self._lock:
            if not self.first_token or not hmac.compare_digest(token.encode(), self.first_token.encode()):
                return None
            self.first_token = ""
        return FIRST_ENGINEER

    def _keep(self, entries: dict[str, dict[str, Any]]) -> None:
        try:
            make_folder(self._path.parent)
            if not self._path.exists():
                self._path.touch(mode=0o600)
            write_synced(self._path, json.dumps(entries, indent=2, ensure_ascii=False))
            self._path.chmod(0o600)
        except OSError as error:
            raise StorageError(f"{self._path}: the account cannot be kept: {error.strerror}") from error
        self._stored = entries


def _key(entry: dict[str, Any]) -> str:
    """Return a key that differs for each account, because each password is hashed with its own salt."""
    return hashlib.sha256(entry["password"].encode()).hexdigest()


def _visible_form(name: str) -> str:
    """Return a name as it looks in a log: names that differ only by capitals, width or spaces are the same
    person."""
    return " ".join(unicodedata.normalize("NFKC", name).casefold().split())


def _has_engineer(entries: dict[str, dict[str, Any]]) -> bool:
    return any(entry["role"] == Role.ENGINEER.word for entry in entries.values())

"""Plans that wait for the cell, in order; kept in a file, so that a restarted service finds what ran."""

from __future__ import annotations

import json
import secrets
import threading
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coupole.errors import InputError, StorageError
from coupole.storage.durable import make_folder, write_synced
from coupole.storage.line_file import utc_now

EntryState = Literal["waiting", "running", "done", "failed", "stopped"]
MOST_WAITING = 200


class Entry(BaseModel):
    """A plan to be run, or a hold: the queue stops there until somebody goes on with it."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    id: str
    """Of this entry."""
    plan: str = ""
    """File of the plan; empty for a hold."""
    hold: str = ""
    """What is to be done before the queue goes on; empty for a plan."""
    by: str
    """Who entered it."""
    entered: str
    """UTC, ISO 8601."""
    state: EntryState = "waiting"
    """How far it is."""
    begun: str = ""
    """UTC; empty while it waits."""
    ended: str = ""
    """UTC; empty until it has ended."""
    pid: int = 0
    """Of the process that acquires; 0 while it waits."""
    run: str = ""
    """Folder of the run, once there is one."""
    exit_code: int | None = None
    """Of the process; None until it has ended, and if it was killed."""
    said: str = ""
    """Why it failed."""


class _Kept(BaseModel):
    model_config = ConfigDict(extra="forbid")

    halted: str = ""
    entries: tuple[Entry, ...] = Field(default=())


class PlanQueue:
    """Entries in their order. Every change is on the disk when the call returns."""

    def __init__(self, path: Path) -> None:
        """Raises StorageError: the file cannot be read."""
        self._path, self._lock = path, threading.RLock()
        try:
            self._kept = _Kept.model_validate_json(path.read_bytes()) if path.exists() else _Kept()
        except (OSError, ValidationError) as error:
            raise StorageError(f"{path}: the queue cannot be read: {error}") from error

    @property
    def entries(self) -> tuple[Entry, ...]:
        return self._kept.entries

    @property
    def halted(self) -> str:
        """Why nothing more begins; empty if something may."""
        return self._kept.halted

    @property
    def running(self) -> Entry | None:
        return next((entry for entry in self.entries if entry.state == "running"), None)

    @property
    def following(self) -> Entry | None:
        """The first that waits, if it may begin now."""
        if self.halted or self.running is not None:
            return None
        return next((entry for entry in self.entries if entry.state == "waiting"), None)

    def add(self, by: str, *, plan: str = "", hold: str = "") -> Entry:
        """A new entry at the end. Raises InputError: too many wait; StorageError."""
        with self._lock:
            if sum(entry.state == "waiting" for entry in self.entries) >= MOST_WAITING:
                raise InputError(f"queue: at most {MOST_WAITING} entries may wait")
            entry = Entry(id=secrets.token_hex(6), plan=plan, hold=hold, by=by, entered=utc_now())
            self._keep((*self.entries, entry), self.halted)
        return entry

    def remove(self, number: str) -> None:
        """Take out an entry that waits. Raises InputError, StorageError."""
        with self._lock:
            entry = self.entry(number)
            if entry.state != "waiting":
                raise InputError(f"queue: {number} is {entry.state}; only what waits can be taken out")
            self._keep(tuple(other for other in self.entries if other.id != number), self.halted)

    def entry(self, number: str) -> Entry:
        """Raises InputError: there is none with this id."""
        found = next((entry for entry in self.entries if entry.id == number), None)
        if found is None:
            raise InputError(f"queue: no entry {number!r}")
        return found

    def change(self, number: str, **fields: object) -> Entry:
        """An entry with other fields. Raises InputError, StorageError."""
        with self._lock:
            changed = self.entry(number).model_copy(update=fields)
            self._keep(tuple(changed if other.id == number else other for other in self.entries), self.halted)
            return changed

    def conclude(self, number: str, *, halt: str = "", **fields: object) -> None:
        """An entry with other fields, and why nothing more begins, in one change. Raises InputError, StorageError:
        nothing more begins all the same."""
        with self._lock:
            changed = self.entry(number).model_copy(update=fields)
            entries = tuple(changed if other.id == number else other for other in self.entries)
            self._keep(entries, halt or self.halted)

    def halt(self, why: str) -> None:
        """Begin nothing more until somebody goes on with it, also if that cannot be written. Raises
        StorageError."""
        with self._lock:
            self._kept = self._kept.model_copy(update={"halted": why})
            self._keep(self.entries, why)

    def go_on(self) -> None:
        """Begin what waits, from now on."""
        with self._lock:
            self._keep(self.entries, "")

    def _keep(self, entries: tuple[Entry, ...], halted: str) -> None:
        kept = _Kept(halted=halted, entries=entries)
        try:
            make_folder(self._path.parent)
            write_synced(self._path, json.dumps(kept.model_dump(), indent=2, ensure_ascii=False))
        except OSError as error:
            raise StorageError(f"{self._path}: the queue cannot be kept: {error.strerror}") from error
        self._kept = kept

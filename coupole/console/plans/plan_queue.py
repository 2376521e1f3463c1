"""Plans that wait for the cell, in order; stored in a file, so that a restarted service finds the running one."""

from __future__ import annotations

import json
import secrets
import threading
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coupole.errors import InputError, StorageError
from coupole.storage.durable import make_folder, write_synced
from coupole.storage.line_file import utc_now

EntryState = Literal["waiting", "running", "done", "failed", "stopped"]
MOST_WAITING, MOST_ENDED = 200, 100


class Needs(BaseModel):
    """Needs of an entry, as preflight found them when it was entered. For a resumed run, these are the needs of
    its rest."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    duration_s: float
    """Duration of the acquisition."""
    preparation_s: float
    """Duration of the preflight, which is made again when the entry begins."""
    dose_lux_h: float
    """Light on the object, in lux hours."""
    bytes: int
    """Size on the disk."""
    frames: int
    """Number of frames, dark frames included."""
    object: str | None = None
    """Id of the object; None if the plan names none."""
    dose_budget_lux_h: float | None = None
    """Total light that the object may receive, in lux hours, including what it has received; None: no limit."""
    folder: str = ""
    """Folder that will contain the run."""
    warnings: tuple[str, ...] = ()
    """Warnings for the operator."""


class Entry(BaseModel):
    """A plan to be run, a run to be resumed, or a hold. At a hold the queue stops until a person continues it."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    id: str
    """Id of this entry."""
    plan: str = ""
    """File of the plan; empty for a hold, and for a run that is resumed with its own copy."""
    hold: str = ""
    """Task to be done before the queue goes on; empty for a plan."""
    resume: str = ""
    """Folder of the run to be resumed; empty for a new one."""
    output: str = ""
    """Folder for the run, if it is not the rig's."""
    with_mesh: bool = False
    """Copy the mesh into the run even if it is large."""
    reflectance: bool = False
    """Process the views during the acquisition, and make the result at its end."""
    result: str = ""
    """Folder of the result; by default the run's name followed by `-reflectance`."""
    needs: Needs | None = None
    """Needs of the entry; None for a hold, and for an entry that began at once."""
    by: str
    """Name of the person who entered it."""
    entered: str
    """UTC, ISO 8601."""
    state: EntryState = "waiting"
    """State of the entry in the queue."""
    begun: str = ""
    """UTC; empty while it waits."""
    ended: str = ""
    """UTC; empty until it has ended."""
    pid: int = 0
    """Id of the acquiring process; 0 while the entry waits."""
    run: str = ""
    """Folder of the run, once there is one."""
    exit_code: int | None = None
    """Exit code of the process; None until it has ended, and if it was killed."""
    said: str = ""
    """Reason why it failed."""

    @property
    def words(self) -> str:
        """Name of the entry, for people."""
        return f"hold: {self.hold}" if self.hold else Path(self.plan or self.resume).name


class _Kept(BaseModel):
    model_config = ConfigDict(extra="forbid")

    halted: str = ""
    entries: tuple[Entry, ...] = Field(default=())


class PlanQueue:
    """Entries in their order, with the `MOST_ENDED` entries that ended last. Every change is on the disk when the
    call returns."""

    def __init__(self, path: Path) -> None:
        """Raises StorageError if the file cannot be read."""
        self._path, self._lock = path, threading.RLock()
        try:
            self._kept = _Kept.model_validate_json(path.read_bytes()) if path.exists() else _Kept()
        except (OSError, ValidationError) as error:
            raise StorageError(f"{path}: the queue cannot be read: {error}") from error

    @property
    def entries(self) -> tuple[Entry, ...]:
        return self._kept.entries

    @property
    def halt_reason(self) -> str:
        """Reason why nothing more begins; empty if entries may begin."""
        return self._kept.halted

    @property
    def running(self) -> Entry | None:
        return next((entry for entry in self.entries if entry.state == "running"), None)

    @property
    def following(self) -> Entry | None:
        """The first waiting entry, if it may begin now."""
        if self.halt_reason or self.running is not None:
            return None
        return next((entry for entry in self.entries if entry.state == "waiting"), None)

    @property
    def waiting(self) -> tuple[Entry, ...]:
        return tuple(entry for entry in self.entries if entry.state == "waiting")

    def add(self, by: str, *, before: str = "", at_once: bool = False, **fields: Any) -> Entry:
        """Add an entry with these fields, before another waiting entry or at the end; return it.

        `at_once`: the entry begins now, whatever the end of the last plan was. Raises InputError if too many
        entries wait, or (with `at_once`) if a plan runs or waits, or the queue is at a hold; StorageError if the
        queue cannot be written.
        """
        with self._lock:
            if len(self.waiting) >= MOST_WAITING:
                raise InputError(f"queue: at most {MOST_WAITING} entries may wait")
            if at_once and (why := self._in_the_way()):
                raise InputError(why)
            entry = Entry(id=secrets.token_hex(6), by=by, entered=utc_now(), **fields)
            self._keep(self._with(entry, before, self.entries), "" if at_once else self.halt_reason)
        return entry

    def move(self, number: str, before: str) -> None:
        """Move a waiting entry before another one, or to the end. Raises InputError, StorageError."""
        with self._lock:
            self._keep(self.order_after(number, before), self.halt_reason)

    def order_after(self, number: str, before: str) -> tuple[Entry, ...]:
        """Return all entries in their order after `move`. Raises InputError."""
        entry = self.waiting_entry(number)
        if before == number:
            raise InputError(f"queue: {number} cannot be put before itself")
        return self._with(
            entry, before, tuple(other_entry for other_entry in self.entries if other_entry.id != number)
        )

    def remove(self, number: str) -> None:
        """Remove a waiting entry. Raises InputError, StorageError."""
        with self._lock:
            self.waiting_entry(number)
            self._keep(tuple(entry for entry in self.entries if entry.id != number), self.halt_reason)

    def waiting_entry(self, number: str) -> Entry:
        """Return a waiting entry. Raises InputError if no entry with this id waits."""
        entry = self.entry(number)
        if entry.state != "waiting":
            raise InputError(f"queue: {number} is {entry.state}; only waiting entries can be removed or moved")
        return entry

    def _with(self, entry: Entry, before: str, entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
        if not before:
            return (*entries, entry)
        place = entries.index(self.waiting_entry(before))
        return (*entries[:place], entry, *entries[place:])

    def _in_the_way(self) -> str:
        """Return why nothing can begin at once; empty if it can. A failed plan does not prevent another one."""
        if self.running is not None:
            return f"{self.running.words} is being acquired"
        if self.waiting:
            return f"{self.waiting[0].words} waits" + (f": {self.halt_reason}" if self.halt_reason else "")
        ended_entries = [entry for entry in self.entries if entry.ended]
        return self.halt_reason if self.halt_reason and ended_entries and ended_entries[-1].hold else ""

    def entry(self, number: str) -> Entry:
        """Return an entry. Raises InputError if there is none with this id."""
        matching_entry = next((entry for entry in self.entries if entry.id == number), None)
        if matching_entry is None:
            raise InputError(f"queue: no entry {number!r}")
        return matching_entry

    def change(self, number: str, **fields: object) -> Entry:
        """Change fields of an entry; return it. Raises InputError, StorageError."""
        with self._lock:
            changed_entry = self.entry(number).model_copy(update=fields)
            self._keep(
                tuple(changed_entry if entry.id == number else entry for entry in self.entries), self.halt_reason
            )
            return changed_entry

    def conclude(self, number: str, *, halt: str = "", **fields: object) -> None:
        """Change fields of an entry and, in the same step, set the reason why nothing more begins. Raises
        InputError and StorageError; even then, nothing more begins."""
        with self._lock:
            changed_entry = self.entry(number).model_copy(update=fields)
            entries = tuple(changed_entry if entry.id == number else entry for entry in self.entries)
            self._keep(entries, halt or self.halt_reason)

    def halt(self, why: str) -> None:
        """Begin nothing more until a person continues the queue. The queue is halted even if this cannot be
        written to the disk; then StorageError is raised."""
        with self._lock:
            self._kept = self._kept.model_copy(update={"halted": why})
            self._keep(self.entries, why)

    def go_on(self, seen_reason: str | None = None) -> None:
        """Begin waiting entries from now on.

        `seen_reason` is the reason of the halt that the person saw. Raises InputError if the reason is a different
        one by now.
        """
        with self._lock:
            if seen_reason is not None and self.halt_reason not in (seen_reason, ""):
                raise InputError(f"queue: it now waits for another reason: {self.halt_reason}")
            self._keep(self.entries, "")

    def _keep(self, entries: tuple[Entry, ...], halt_reason: str) -> None:
        old_ids = {entry.id for entry in [entry for entry in entries if entry.ended][:-MOST_ENDED]}
        entries = tuple(entry for entry in entries if entry.id not in old_ids)
        queue = _Kept(halted=halt_reason, entries=entries)
        try:
            make_folder(self._path.parent)
            write_synced(self._path, json.dumps(queue.model_dump(), indent=2, ensure_ascii=False))
        except OSError as error:
            raise StorageError(f"{self._path}: the queue cannot be kept: {error.strerror}") from error
        self._kept = queue

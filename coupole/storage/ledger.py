"""The dose ledger of each object: all light that it has received, `<ledger folder>/<object id>.jsonl`.

A caller that gives light enters the planned light first (`Ledger.plan`), and afterwards the light that was given
(`Ledger.correct`); both are on disk when the call returns. So if the process is killed or the power fails, the
planned light counts, and the figure can only be too high. Writers hold a lock on the object's file.

The object's budget is in the same file. A plan is entered only if the budget allows it, with all entries of the
file at that moment, under the same lock. So even if several processes give light at once, the sum of their light
never exceeds the budget.
"""

from __future__ import annotations

import fcntl
import math
import os
import re
import stat
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from coupole.errors import InputError, StorageError
from coupole.intake.regular_file import NO_FILE
from coupole.plan.base_model import Name
from coupole.plan.cell import Cell
from coupole.storage.disk_errors import disk_error
from coupole.storage.ledger_lines import (
    Asked,
    BudgetSet,
    History,
    LightEntered,
    LightGiven,
    LightPlanned,
    Line,
    Reading,
    WarningSet,
    history_of,
    read_lines,
)
from coupole.storage.line_file import LineFile

LOCK_S = 10.0
"""Longest wait for the lock. Other writers hold it for one line each."""
_NAP_S = 0.01
_ROOM_BYTES = 2**18
"""Room for the lines of about 700 bursts."""
_NAME: TypeAdapter[str] = TypeAdapter(Name)


class Ledger:
    """The ledger of one object in `folder`; entries in `former_folder`, the place of version 0.1, count too."""

    def __init__(
        self, folder: Path, object_id: str, former_folder: Path | None = None, *, only_grows: bool = False
    ) -> None:
        """`only_grows`: `newest`, `plan` and `ask_again` raise StorageError if lines that were read or planned are
        gone, or if the file is not text. Raises InputError for an id that no plan can have."""
        try:
            self.object_id = _NAME.validate_python(object_id)
        except ValidationError as error:
            raise InputError(
                f"object {object_id!r}: expected an id as in a plan: up to 64 letters, digits, dots, underscores "
                "and hyphens, the first a letter or digit" + _did_you_mean(similar_ids(folder, object_id))
            ) from error
        self.folder, self._former_folder = folder, former_folder
        self.path = folder / f"{object_id}.jsonl"
        self._reading = Reading(only_grows=only_grows)

    def read_history(self) -> History:
        """Return all light and budgets of the object. Raises StorageError if a file cannot be read."""
        texts = read_lines(self.path)
        return history_of([*self._former_lines(texts), *texts])

    def newest(self) -> History:
        """Return the same as `read_history`, but read only new lines, for callers that ask often. The caller must
        not change the history."""
        self._reading = self._reading.with_new_lines(self.path)
        if self._former_folder is not None and (self._former_folder / self.path.name).exists():
            return self.read_history()
        return self._reading.history

    def plan(
        self, run: str, dose_lux_h: float, damage_wh_m2: float | None, budget_request: Asked | None = None
    ) -> str:
        """Enter the most light that is about to be given; return the id for `correct`.

        The budget is checked for `budget_request`. A plan's budget becomes the object's if the object has none.
        Raises DoseBudgetReached, and StorageError if earlier lines are missing; nothing is entered then.
        """
        line = LightPlanned(id=uuid.uuid4().hex, run=run, dose_lux_h=dose_lux_h, damage_wh_m2=damage_wh_m2)
        lines: list[Line] = [line]
        with self._open_locked() as file:
            history = self.newest()
            self._refuse_lacking(history)
            if budget_request is not None:
                budget_request.refuse_beyond(self.object_id, history)
                if budget_request.budget_lux_h is not None and history.budget_lux_h is None:
                    lines.insert(0, budget_request.as_the_objects())
            file.append([new_line.model_dump_json() + "\n" for new_line in lines])
            self.newest()  # its own line too must be there from now on
        return line.id

    def _refuse_lacking(self, history: History) -> None:
        if history.lacks_lines:
            raise StorageError(
                f"{self.path}: counts light for a plan whose own line is not there, so earlier lines are "
                "missing: the ledger was moved or replaced while light was given, and it is not known what the "
                "object may still receive. Put the whole ledger back; if it is lost, give `coupole dose "
                f"{self.object_id} --add LUX_H --note WHY` with the light that it had received, or with 0"
            )

    def ask_again(self, budget_request: Asked, plan_id: str) -> None:
        """Check the budget once more, for light whose plan has this id. Raises DoseBudgetReached."""
        with self._open_locked():
            history = self.newest()
            budget_request.refuse_beyond(self.object_id, history, -history.planned_lux_h(plan_id))

    def correct(self, plan_id: str, dose_lux_h: float, damage_wh_m2: float | None) -> None:
        """Enter the light that was given of that plan, in place of the planned light."""
        self._append(LightGiven(id=plan_id, dose_lux_h=dose_lux_h, damage_wh_m2=damage_wh_m2))

    def enter(self, dose_lux_h: float, note: str) -> None:
        """Enter light that was given elsewhere, for example in a photographer's studio. Raises InputError if the
        dose is not a valid figure."""
        self._refuse_no_figure("light", dose_lux_h)
        self._append(LightEntered(dose_lux_h=dose_lux_h, note=note))

    def set_budget(self, dose_lux_h: float, name: str, reason: str = "") -> None:
        """Set the light that the object may receive in its life, on the responsibility of this person. Raises
        InputError without a name."""
        if not name.strip():
            raise InputError(f"object {self.object_id}: expected the name of the person who sets its light budget")
        self._refuse_no_figure("a budget", dose_lux_h)
        self._append(BudgetSet(dose_lux_h=dose_lux_h, name=name.strip(), reason=reason.strip()))

    def warn_above(self, dose_lux_h: float | None) -> None:
        """Set the dose above which there is a warning. Raises InputError if the dose is not a valid figure."""
        if dose_lux_h is not None:
            self._refuse_no_figure("a limit", dose_lux_h)
        self._append(WarningSet(dose_lux_h=dose_lux_h))

    def _refuse_no_figure(self, quantity: str, dose_lux_h: float) -> None:
        if not (math.isfinite(dose_lux_h) and dose_lux_h >= 0):
            raise InputError(
                f"object {self.object_id}: expected {quantity} of 0 lux.h or more, found {dose_lux_h}"
            )

    def prove_writable(self) -> None:
        """Raise StorageError now if lines could not be appended later, and DiskFull if the disk has no room for
        them."""
        with self._open_locked():
            try:
                with tempfile.TemporaryFile(dir=self.folder) as file:
                    file.write(bytes(_ROOM_BYTES))
                    file.flush()
                    os.fsync(file.fileno())
            except PermissionError:  # the ledger itself can be written, so it is enough
                return
            except OSError as error:
                raise disk_error(self.folder, error) from error

    def _former_lines(self, texts: list[bytes]) -> list[bytes]:
        """Return lines of the former place that are not also in the present one."""
        if self._former_folder is None:
            return []
        known_texts = set(texts)
        return [text for text in read_lines(self._former_folder / self.path.name) if text not in known_texts]

    def _append(self, line: Line) -> None:
        with self._open_locked() as file:
            file.append([line.model_dump_json() + "\n"])

    @contextmanager
    def _open_locked(self) -> Iterator[LineFile]:
        try:
            new = [folder for folder in (self.folder, *self.folder.parents) if not folder.exists()]
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StorageError(f"{self.path}: cannot write the dose ledger: {error.strerror}") from error
        try:
            if not stat.S_ISREG(os.fstat(lock).st_mode):
                raise StorageError(f"{self.path}: cannot write the dose ledger: {NO_FILE}")
            self._take(lock)
            file = LineFile(self.path)
            try:
                if file.was_empty:
                    _sync_folders([self.folder, *(folder.parent for folder in new)])
                yield file
            finally:
                file.close()
        finally:
            os.close(lock)

    def _take(self, lock: int) -> None:
        """Wait for the lock on the open file `lock`. The lock is released when the file is closed."""
        end_s = time.monotonic() + LOCK_S
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                if time.monotonic() > end_s:
                    raise StorageError(
                        f"{self.path}: another process has held the lock of the dose ledger for {LOCK_S:g} s. "
                        "End it, then try again."
                    ) from error
                time.sleep(_NAP_S)
            except OSError as error:
                raise StorageError(f"{self.path}: cannot lock the dose ledger: {error.strerror}") from error
            else:
                return


def ledger_of(cell: Cell, object_id: str, *, only_grows: bool = False) -> Ledger:
    """Return the ledger of an object in the place that the cell's rig names."""
    return Ledger(cell.ledger_folder, object_id, cell.former_ledger_folder, only_grows=only_grows)


def similar_ids(folder: Path, object_id: str) -> list[str]:
    """Return ids of other objects in a folder of ledgers that differ only in case, blanks, dots, hyphens or
    underscores."""
    try:
        ids = sorted(path.stem for path in folder.glob("*.jsonl"))
    except OSError as error:
        raise StorageError(f"{folder}: cannot read the dose ledgers: {error.strerror}") from error
    return [listed_id for listed_id in ids if listed_id != object_id and _plain(listed_id) == _plain(object_id)]


def _plain(object_id: str) -> str:
    return re.sub(r"[\s._-]", "", object_id).casefold()


def _did_you_mean(ids: list[str]) -> str:
    return f"; did you mean `{ids[0]}`?" if ids else ""


def _sync_folders(folders: list[Path]) -> None:
    """Sync the folders' entries, so that a new file is still there after a power cut."""
    for folder in folders:
        fd = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)

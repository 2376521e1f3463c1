"""The dose ledger of each object: all light that it has received, `<ledger folder>/<object id>.jsonl`.

Whoever gives light enters what is planned before it is given (`Ledger.plan`), and afterwards what was given
(`Ledger.correct`); both are on disk when the call returns. So a process that is killed, or a power cut, can only
leave too high a figure: that of the last plan. Writers hold a lock on the object's file.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from coupole.errors import InputError, StorageError
from coupole.plan.cell import Cell
from coupole.plan.plan import Name
from coupole.storage.line_file import LineFile, utc_now

BY_HAND = "by hand"
"""In place of a run's name, for light that was entered with `coupole dose --add`."""
LOCK_S = 10.0
"""Other writers hold the lock for one line each."""
_NAP_S = 0.01
_NAME: TypeAdapter[str] = TypeAdapter(Name)
Amount = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]


class _Line(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore")

    t: str = Field(default_factory=utc_now)


class _Light(_Line):
    dose_lux_h: Amount
    damage_wh_m2: Amount | None = None
    """Radiant exposure weighted by damage (`coupole.appearance.spectra.damage`); None if the lamps' spectrum is
    not known."""


class LightEntered(_Light):
    """Light that was given: by hand, or by version 0.1."""

    event: Literal["dose"] = "dose"
    run: str = BY_HAND
    note: str = ""


class LightPlanned(_Light):
    """Light that is about to be given, at most."""

    event: Literal["planned"] = "planned"
    id: str
    run: str
    """Name of the run's folder, or `meter`, or `live`."""


class LightGiven(_Light):
    """What was given of the plan with this id."""

    event: Literal["given"] = "given"
    id: str


class WarningSet(_Line):
    """From now on a total above this is warned of; None: no total is."""

    event: Literal["warn_above"] = "warn_above"
    dose_lux_h: Amount | None


Line: TypeAlias = LightEntered | LightPlanned | LightGiven | WarningSet
_LINE: TypeAdapter[Line] = TypeAdapter(Annotated[Line, Field(discriminator="event")])


@dataclass
class Entry:
    """Light of one burst, of one second of a live view, or entered by hand."""

    t: str
    run: str
    dose_lux_h: float
    damage_wh_m2: float | None
    note: str = ""
    settled: bool = True
    """False while only the plan is known: what was given is at most this."""


@dataclass
class History:
    """All light of one object."""

    entries: list[Entry] = field(default_factory=list)
    warn_above_lux_h: float | None = None
    unreadable: int = 0
    """Lines that are no entries: torn by a crash before their light was given, or damaged later."""

    @property
    def total_lux_h(self) -> float:
        return sum(entry.dose_lux_h for entry in self.entries)

    @property
    def damage_wh_m2(self) -> float:
        """Of the light whose spectrum is known."""
        return sum(entry.damage_wh_m2 or 0.0 for entry in self.entries)

    @property
    def of_unknown_spectrum_lux_h(self) -> float:
        return sum(entry.dose_lux_h for entry in self.entries if entry.damage_wh_m2 is None)

    @property
    def unsettled_lux_h(self) -> float:
        """Planned, with nobody left who could say what was given."""
        return sum(entry.dose_lux_h for entry in self.entries if not entry.settled)

    def of_run(self, run: str) -> History:
        return History([entry for entry in self.entries if entry.run == run])

    @property
    def runs(self) -> list[str]:
        """In the order of their first light."""
        return list(dict.fromkeys(entry.run for entry in self.entries))


class Ledger:
    """The ledger of one object in `folder`; entries in `former_folder`, the place of version 0.1, count too."""

    def __init__(self, folder: Path, object_id: str, former_folder: Path | None = None) -> None:
        """Raises InputError for an id that no plan can have."""
        try:
            self.object_id = _NAME.validate_python(object_id)
        except ValidationError as error:
            raise InputError(
                f"object {object_id!r}: expected an id as in a plan: up to 64 letters, digits, dots, underscores "
                "and hyphens, the first a letter or digit" + _did_you_mean(similar_ids(folder, object_id))
            ) from error
        self.folder, self._former_folder = folder, former_folder
        self.path = folder / f"{object_id}.jsonl"

    def read(self) -> History:
        """Raises StorageError if a file cannot be read."""
        texts = _lines(self.path)
        history, by_id = History(), dict[str, Entry]()
        for text in [*self._former_lines(texts), *texts]:
            try:
                _add(history, by_id, _LINE.validate_json(text))
            except ValidationError:
                history.unreadable += bool(text.strip())
        return history

    def plan(self, run: str, dose_lux_h: float, damage_wh_m2: float | None) -> str:
        """Light that is about to be given, at most; returns the id for `correct`."""
        line = LightPlanned(id=uuid.uuid4().hex, run=run, dose_lux_h=dose_lux_h, damage_wh_m2=damage_wh_m2)
        self._append(line)
        return line.id

    def correct(self, plan_id: str, dose_lux_h: float, damage_wh_m2: float | None) -> None:
        """What was given of that plan, in place of it."""
        self._append(LightGiven(id=plan_id, dose_lux_h=dose_lux_h, damage_wh_m2=damage_wh_m2))

    def enter(self, dose_lux_h: float, note: str) -> None:
        """Light that others have given, in a photographer's studio for example."""
        self._append(LightEntered(dose_lux_h=dose_lux_h, note=note))

    def warn_above(self, dose_lux_h: float | None) -> None:
        self._append(WarningSet(dose_lux_h=dose_lux_h))

    def prove_writable(self) -> None:
        """Raise StorageError now if lines could not be appended later."""
        with self._locked():
            pass

    def _former_lines(self, texts: list[bytes]) -> list[bytes]:
        """Lines of the former place that are not in the present one too."""
        if self._former_folder is None:
            return []
        known = set(texts)
        return [text for text in _lines(self._former_folder / self.path.name) if text not in known]

    def _append(self, line: Line) -> None:
        with self._locked() as file:
            file.append([line.model_dump_json() + "\n"])

    @contextmanager
    def _locked(self) -> Iterator[LineFile]:
        try:
            new = [folder for folder in (self.folder, *self.folder.parents) if not folder.exists()]
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StorageError(f"{self.path}: cannot write the dose ledger: {error.strerror}") from error
        try:
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
        """Wait for the lock on the open file `lock`, which is released when that is closed."""
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


def ledger_of(cell: Cell, object_id: str) -> Ledger:
    """The ledger of an object in the place that the cell's rig names."""
    return Ledger(cell.ledger_folder, object_id, cell.former_ledger_folder)


def similar_ids(folder: Path, object_id: str) -> list[str]:
    """Ids of other objects in a folder of ledgers that differ only in case, blanks, dots, hyphens, underscores."""
    try:
        others = sorted(path.stem for path in folder.glob("*.jsonl"))
    except OSError as error:
        raise StorageError(f"{folder}: cannot read the dose ledgers: {error.strerror}") from error
    return [other for other in others if other != object_id and _plain(other) == _plain(object_id)]


def _plain(object_id: str) -> str:
    return re.sub(r"[\s._-]", "", object_id).casefold()


def _did_you_mean(ids: list[str]) -> str:
    return f"; did you mean `{ids[0]}`?" if ids else ""


def _lines(path: Path) -> list[bytes]:
    try:
        return path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path}: cannot read the dose ledger: {error.strerror}") from error


def _add(history: History, by_id: dict[str, Entry], line: Line) -> None:
    """A correction counts in place of its plan; one whose plan cannot be read counts by itself."""
    if isinstance(line, WarningSet):
        history.warn_above_lux_h = line.dose_lux_h
        return
    if isinstance(line, LightGiven):
        entry = by_id.get(line.id)
        if entry is not None:
            entry.dose_lux_h, entry.damage_wh_m2, entry.settled = line.dose_lux_h, line.damage_wh_m2, True
            return
        entry = Entry(line.t, "unknown", line.dose_lux_h, line.damage_wh_m2)
    elif isinstance(line, LightPlanned):
        entry = by_id[line.id] = Entry(line.t, line.run, line.dose_lux_h, line.damage_wh_m2, settled=False)
    else:
        entry = Entry(line.t, line.run, line.dose_lux_h, line.damage_wh_m2, line.note)
    history.entries.append(entry)


def _sync_folders(folders: list[Path]) -> None:
    """Sync the folders' entries, so that a new file is still there after a power cut."""
    for folder in folders:
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)

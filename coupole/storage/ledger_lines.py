"""The lines of an object's dose ledger, and the history that follows from them: all light on it, and its
budget."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, BinaryIO, ClassVar, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from coupole.errors import DoseBudgetReached, StorageError
from coupole.intake.regular_file import open_regular
from coupole.storage.line_file import utc_now

BY_HAND = "by hand"
"""Name instead of a run's name, for light that was entered with `coupole dose --add`."""
_ROUNDING = 1e-9
_ROUNDING_LUX_H = 1e-6
"""Largest rounding error of the sum of all entries of a run."""
_TAIL_BYTES = 256
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
    """Greatest light that is about to be given."""

    event: Literal["planned"] = "planned"
    id: str
    run: str
    """Name of the run's folder, or `meter`, or `live`."""


class LightGiven(_Light):
    """Light that was given under the plan with this id."""

    event: Literal["given"] = "given"
    id: str


class WarningSet(_Line):
    """Total light of the object above which there is a warning from now on; None: no warning."""

    event: Literal["warn_above"] = "warn_above"
    dose_lux_h: Amount | None


class BudgetSet(_Line):
    """Light that the object may receive in its life from now on, on the responsibility of this person."""

    event: Literal["budget"] = "budget"
    dose_lux_h: Amount
    name: str
    reason: str = ""


Line: TypeAlias = LightEntered | LightPlanned | LightGiven | WarningSet | BudgetSet
_LINE: TypeAdapter[Line] = TypeAdapter(Annotated[Line, Field(discriminator="event")])


@dataclass
class Entry:
    """Light of one burst, of one second of a live view, or entered by hand."""

    t: str
    run: str
    dose_lux_h: float
    damage_wh_m2: float | None
    note: str = ""
    is_settled: bool = True
    """False while only the plan is known; the light that was given is at most this."""


@dataclass
class History:
    """All light of one object."""

    entries: list[Entry] = field(default_factory=list)
    of_plan: dict[str, Entry] = field(default_factory=dict)
    """Entries of planned light, by their id."""
    warn_above_lux_h: float | None = None
    budgets: list[BudgetSet] = field(default_factory=list)
    """Budgets in the order in which they were set. The last one counts."""
    without_plan: int = 0
    """Number of lines since the last entry by hand that state given light but whose plan is missing."""
    unreadable: int = 0
    """Number of lines that are not entries: a crash cut them before their light was given, or they were damaged
    later."""

    @property
    def lacks_lines(self) -> bool:
        """True if earlier lines are missing: more plans are missing than damaged lines explain."""
        return self.without_plan > self.unreadable

    @property
    def unreadable_words(self) -> str:
        """Sentence for a person: how many lines of the ledger cannot be read."""
        return f"{self.unreadable} line{'s' if self.unreadable != 1 else ''} of the ledger cannot be read"

    @property
    def is_empty(self) -> bool:
        """True if nothing was ever entered. Then the object is new, or its file was moved away."""
        return not self.entries and not self.budgets and self.warn_above_lux_h is None and not self.unreadable

    @property
    def total_lux_h(self) -> float:
        return sum(entry.dose_lux_h for entry in self.entries)

    @property
    def budget_lux_h(self) -> float | None:
        """The object's own budget; None if nobody has set one."""
        return self.budgets[-1].dose_lux_h if self.budgets else None

    def allowed_lux_h(self, plans_lux_h: float | None) -> float | None:
        """Return the light that the object may receive in its life: the smaller of its budget and a plan's; None
        without both."""
        budgets_lux_h = [
            budget_lux_h for budget_lux_h in (self.budget_lux_h, plans_lux_h) if budget_lux_h is not None
        ]
        return min(budgets_lux_h, default=None)

    @property
    def damage_wh_m2(self) -> float:
        """Damage by the light whose spectrum is known."""
        return sum(entry.damage_wh_m2 or 0.0 for entry in self.entries)

    @property
    def of_unknown_spectrum_lux_h(self) -> float:
        return sum(entry.dose_lux_h for entry in self.entries if entry.damage_wh_m2 is None)

    @property
    def unsettled_lux_h(self) -> float:
        """Planned light, if it can no longer be found out how much of it was given."""
        return sum(entry.dose_lux_h for entry in self.entries if not entry.is_settled)

    def planned_lux_h(self, plan_id: str) -> float:
        """Return the light that counts for the plan with this id; 0 if the plan is not known."""
        return self.of_plan[plan_id].dose_lux_h if plan_id in self.of_plan else 0.0

    def of_run(self, run: str) -> History:
        return History([entry for entry in self.entries if entry.run == run])

    def refuse_without_light_of(self, object_id: str, run: str, lux_h: float) -> None:
        """Raise StorageError if less is entered in all than `lux_h`, which the journal of a single run states. The
        run's own entries are not compared: they have its folder's name, and the folder may have been renamed."""
        if self.total_lux_h < lux_h - _ROUNDING_LUX_H:
            raise StorageError(
                f"object {object_id}: by its journal, the run {run} has given it {lux_h:.6f} lux.h, but its dose "
                f"ledger has only {self.total_lux_h:.6f} lux.h in all: lines are missing. Put the whole ledger "
                f"back; if it is lost, give `coupole dose {object_id} --add LUX_H --note WHY` with the light that "
                "is missing"
            )

    @property
    def runs(self) -> list[str]:
        """Return the runs in the order of their first light."""
        return list(dict.fromkeys(entry.run for entry in self.entries))


@dataclass(frozen=True)
class Asked:
    """Light that is requested under a plan."""

    lux_h: float
    budget_lux_h: float | None
    """The plan's own budget. It can only make the object's budget stricter."""
    plan: str = ""
    name: str = ""
    """Person who runs the plan."""

    def refuse_beyond(self, object_id: str, history: History, more_lux_h: float = 0.0) -> None:
        """Raise DoseBudgetReached if this light is too much, together with the ledger's light and `more_lux_h`."""
        total_lux_h, allowed_lux_h = history.total_lux_h + more_lux_h, history.allowed_lux_h(self.budget_lux_h)
        if allowed_lux_h is None or total_lux_h + self.lux_h <= allowed_lux_h * (1.0 + _ROUNDING):
            return
        remedy = f"If it may receive more, give `coupole dose {object_id} --budget LUX_H --name NAME`"
        if history.budget_lux_h is None or allowed_lux_h < history.budget_lux_h:
            remedy = (
                "Raise `dose_budget_lux_h` in the plan if the object may receive it (and name the plan when you "
                "resume a run: `coupole acquire PLAN --resume RUN`)"
            )
        raise DoseBudgetReached(
            f"object {object_id}: the next {self.lux_h:.3g} lux.h after {total_lux_h:.3f} lux.h would exceed its "
            f"budget of {allowed_lux_h:g} lux.h. {remedy}"
        )

    def as_the_objects(self) -> BudgetSet:
        """Return the plan's budget as the budget of an object that has none."""
        assert self.budget_lux_h is not None
        return BudgetSet(
            dose_lux_h=self.budget_lux_h, name=self.name, reason=f"the first budget, by the plan {self.plan}"
        )


def read_lines(path: Path) -> list[bytes]:
    """Return the lines of a file; none if there is no file. Raises StorageError."""
    try:
        with open_regular(path) as file:
            return file.read().split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise _unreadable(path, error) from error


def history_of(texts: list[bytes]) -> History:
    """Build the history from these lines."""
    reading = Reading()
    for text in texts:
        reading.take(text)
    return reading.history


class Reading:
    """Part of a ledger that has been read, while others go on writing the ledger."""

    def __init__(self, *, only_grows: bool = False) -> None:
        """`only_grows`: the file must keep lines that were read, and must be text; otherwise `with_new_lines`
        raises StorageError."""
        self.history = History()
        self._only_grows = only_grows
        self._inode, self._read_bytes, self._tail = 0, 0, b""

    def with_new_lines(self, path: Path) -> Reading:
        """Add the complete lines that are new. If the file was replaced, read all its lines again. Raises
        StorageError."""
        try:
            with open_regular(path) as file:
                return self._with_rest(path, file)
        except FileNotFoundError:
            self._refuse_loss(path, "was removed")
            return Reading(only_grows=self._only_grows)
        except OSError as error:
            raise _unreadable(path, error) from error

    def _refuse_loss(self, path: Path, loss: str) -> None:
        if self._only_grows and self._read_bytes:
            raise StorageError(
                f"{path}: the dose ledger {loss} while light was given, so it is not known what the object may "
                "still receive. Put it back, then continue."
            )

    def _with_rest(self, path: Path, file: BinaryIO) -> Reading:
        inode, begin = os.fstat(file.fileno()).st_ino, self._read_bytes - len(self._tail)
        file.seek(begin)
        if file.read(len(self._tail)) != self._tail:
            self._refuse_loss(path, "lost lines, or is another file,")
            reading = Reading(only_grows=self._only_grows)
            file.seek(0)
        elif inode != self._inode and not self._only_grows:
            reading = Reading()
            file.seek(0)
        else:
            reading = self
        rest, _, _ = (file.read()).rpartition(b"\n")
        if self._only_grows and b"\0" in rest:
            raise StorageError(
                f"{path}: expected text in UTF-8, found bytes 0 (UTF-16, or a damaged file), so it is not known "
                "what the object may still receive. Restore the dose ledger, then continue."
            )
        if rest:
            for text in rest.split(b"\n"):
                reading.take(text)
            reading._inode, reading._read_bytes = inode, reading._read_bytes + len(rest) + 1
            reading._tail = (reading._tail + rest + b"\n")[-_TAIL_BYTES:]
        return reading

    def take(self, text: bytes) -> None:
        """Take one more line."""
        try:
            line = _LINE.validate_json(text)
        except ValidationError:
            self.history.unreadable += bool(text.strip())
        else:
            _add(self.history, line)


def _unreadable(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{path}: cannot read the dose ledger: {error.strerror}")


def _add(history: History, line: Line) -> None:
    """Add a line. A correction replaces its plan. A correction whose plan cannot be read counts by itself."""
    if isinstance(line, WarningSet):
        history.warn_above_lux_h = line.dose_lux_h
        return
    if isinstance(line, BudgetSet):
        history.budgets.append(line)
        return
    if isinstance(line, LightGiven):
        entry = history.of_plan.get(line.id)
        if entry is not None:
            entry.dose_lux_h, entry.damage_wh_m2, entry.is_settled = line.dose_lux_h, line.damage_wh_m2, True
            return
        entry = Entry(line.t, "unknown", line.dose_lux_h, line.damage_wh_m2)
        history.without_plan += 1
    elif isinstance(line, LightPlanned):
        entry = Entry(line.t, line.run, line.dose_lux_h, line.damage_wh_m2, is_settled=False)
        history.of_plan[line.id] = entry
    else:
        entry = Entry(line.t, line.run, line.dose_lux_h, line.damage_wh_m2, line.note)
        history.without_plan = 0
    history.entries.append(entry)

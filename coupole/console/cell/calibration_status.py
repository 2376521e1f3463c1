"""The records in force for a cell: their age, validity and margins, and the plans that they refuse; and the
campaigns that make new records."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args

from coupole.calibration.campaign_steps import MESH, STEPS, Step
from coupole.calibration.in_force import NEEDED, InForce, refusals
from coupole.calibration.record import Kind, Record, read_record
from coupole.errors import CoupoleError, InputError
from coupole.plan import yamlfile
from coupole.plan.cell import Cell, read_cell
from coupole.plan.reading import read_plan
from coupole.preflight.situation import situation_of
from coupole.storage.durable import make_folder

OF_A_CELL = tuple(step for step in STEPS if step.name != MESH)
"""Steps that need no object."""
USUAL = tuple(kind for step in OF_A_CELL for kind in step.records)
"""Kinds of records of a whole cell, in the order in which they are made."""
_DAY_S = 86400.0


@dataclass(frozen=True)
class RecordRow:
    """A kind of record, and its record in force."""

    kind: str
    path: Path | None = None
    """None if no record of this kind is in force."""
    is_needed: bool = False
    """True if plans that require calibrations need a record of this kind."""
    created_at: str = ""
    """UTC, ISO 8601."""
    age_days: float = 0.0
    left_days: float = 0.0
    """Days until the record expires; below 0 when it has expired."""
    tightest: str = ""
    """The limit with the smallest margin."""
    margin: float | None = None
    """Distance of the figure from its tightest limit, as a share of the limit; below 0 if the limit is exceeded;
    None without limits."""
    against: tuple[str, ...] = ()
    """Reasons why plans must not use the record with this cell."""


@dataclass(frozen=True)
class PlanRow:
    """A plan in the folder of plans, and whether its records refuse it."""

    plan: str
    wants: bool
    """True if the plan requires calibrations."""
    against: tuple[str, ...]
    """Reasons why the records refuse the plan; empty if they do not."""


@dataclass(frozen=True)
class StepNow:
    """The progress of one step of a campaign."""

    step: Step
    accepted_kinds: tuple[str, ...]
    """Kinds of the step's records that exist and are accepted."""
    missed_limits: tuple[str, ...]
    """Limits that the step's records exceed."""

    @property
    def is_done(self) -> bool:
        return set(self.accepted_kinds) == set(self.step.records)


class CalibrationStatus:
    """Records and campaigns of a cell; a file is read again when it has changed."""

    def __init__(self, cell: Cell, plans: Path) -> None:
        self.rig_path, self._plans = cell.document.path, plans
        self._campaigns = cell.storage_folder / "calibrations"
        self._lock = threading.Lock()
        self._known: dict[str, tuple[object, object]] = {}

    def records(self) -> list[RecordRow]:
        """Return all kinds that a cell usually has, and other kinds in force. Raises InputError if the rig is
        wrong."""
        cell = read_cell(self.rig_path)
        record_names = cell.rig.calibrations
        rows = [
            _row(cell.document.resolve(path), cell) for path in ([] if record_names == "none" else record_names)
        ]
        kinds = [*USUAL, *(kind for kind in get_args(Kind) if kind not in USUAL), ""]
        rows_in_force = [row for kind in kinds for row in rows if row.kind == kind]
        missing = [
            RecordRow(kind, is_needed=bool(rows) and kind in NEEDED)
            for kind in USUAL
            if kind not in {r.kind for r in rows_in_force}
        ]
        return sorted([*rows_in_force, *missing], key=lambda row: kinds.index(row.kind))

    def plans(self) -> list[PlanRow]:
        """Return the plans for this rig, by name."""
        with self._lock:
            return [row for path in sorted(self._plans.rglob("*.yaml")) if (row := self._plan(path)) is not None]

    def _plan(self, path: Path) -> PlanRow | None:
        try:
            document = yamlfile.read_document(path)
            rig = document.data.get("rig") if "views" in document.data else None
            if not isinstance(rig, str) or document.resolve(Path(rig)).resolve() != self.rig_path.resolve():
                return None
            name = str(path.relative_to(self._plans))
            files = read_plan(path)
            if files.record_paths is None:
                return PlanRow(name, wants=False, against=())
            records_in_force = [
                InForce(record_path, self._record(record_path)) for record_path in files.record_paths
            ]
        except InputError as error:
            return PlanRow(str(path.relative_to(self._plans)), wants=True, against=tuple(str(error).splitlines()))
        return PlanRow(name, wants=True, against=tuple(refusals(records_in_force, situation_of(files.cell.rig))))

    def _record(self, path: Path) -> Record:
        """Read a record; while its file stays the same, it is read once for all plans."""
        mtime_ns = path.stat().st_mtime_ns
        known_mtime_ns, record = self._known.get(str(path), (None, None))
        if known_mtime_ns != mtime_ns or not isinstance(record, Record):
            record = read_record(path)
            self._known[str(path)] = mtime_ns, record
        return record

    # -- campaigns --------------------------------------------------------------------------------------------

    def campaign(self) -> Path | None:
        """Folder of the newest campaign; None if there is none."""
        folders = sorted(self._campaigns.iterdir()) if self._campaigns.is_dir() else []
        return folders[-1] if folders else None

    def new_campaign(self) -> Path:
        """Return a folder for new records. Raises StorageError."""
        folder = self._campaigns / datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        make_folder(folder)
        return folder

    def steps(self, folder: Path) -> list[StepNow]:
        """Return the progress of each step of a campaign."""
        return [_step(step, folder) for step in OF_A_CELL]

    def lines_for_the_rig(self, folder: Path) -> str:
        """Return the lines of a rig that put a campaign's records in force for all its plans."""
        paths = [folder / f"{kind}.yaml" for kind in USUAL]
        there = [os.path.relpath(path, self.rig_path.resolve().parent) for path in paths if path.is_file()]
        return "\n".join(["calibrations:", *(f"  - {path}" for path in there)])


def _row(path: Path, cell: Cell) -> RecordRow:
    try:
        record = read_record(path)
    except CoupoleError as error:
        return RecordRow("", path, against=tuple(str(error).splitlines()))
    now = datetime.now(UTC)
    ratios = [(limit.found / limit.limit, limit) for limit in record.limits if limit.limit > 0]
    worst = max(ratios, key=lambda entry: entry[0], default=None)
    return RecordRow(
        kind=record.kind,
        path=path,
        is_needed=record.kind in NEEDED,
        created_at=record.created.isoformat(),
        age_days=(now - record.created).total_seconds() / _DAY_S,
        left_days=(record.validity.expires - now).total_seconds() / _DAY_S,
        tightest=_limit_words(worst[1].what, worst[1].found, worst[1].limit, worst[1].unit) if worst else "",
        margin=1 - worst[0] if worst else None,
        against=tuple(_without(path, refusals([InForce(path, record)], situation_of(cell.rig), needed_kinds=()))),
    )


def _step(step: Step, folder: Path) -> StepNow:
    passed_kinds, problems = [], []
    for kind in step.records:
        path = folder / f"{kind}.yaml"
        if not path.is_file():
            continue
        try:
            wrong = [limit for limit in read_record(path).limits if not limit.is_met]
        except CoupoleError as error:
            problems.append(str(error))
            continue
        problems += [
            f"{kind}: {_limit_words(failed_limit.what, failed_limit.found, failed_limit.limit, failed_limit.unit)}"
            for failed_limit in wrong
        ]
        passed_kinds += [] if wrong else [kind]
    return StepNow(step, tuple(passed_kinds), tuple(problems))


def _limit_words(quantity: str, value: float, limit: float, unit: str) -> str:
    return f"{quantity}: {value:.3g} of at most {limit:.3g} {unit}".rstrip()


def _without(path: Path, reasons: Sequence[str]) -> list[str]:
    return [reason.removeprefix(f"{path}: ") for reason in reasons]

"""Faults of a cell's arm, and confirmations of persons who have been at the cell: `arm.jsonl`, in each place of
that arm.

A fault belongs to the arm, not to the run in which it happened, nor to the rig. A named person must confirm that
the cause is found and the cell is clear; until then no session of any run may move that arm. So the fault is noted
under the address and the serial number of the arm's controller, and in the rig's state folder
(`coupole.plan.controller_places`). The fault stands as long as it is in one of these places. A confirmation names
the faults that it confirms, and is valid in all places.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from coupole.devices import Identity
from coupole.errors import DeviceFault, StorageError
from coupole.plan.cell import Cell
from coupole.plan.controller_places import places_of_arm
from coupole.storage.durable import make_folder
from coupole.storage.line_file import LineFile, utc_now


class _Line(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")

    t: str = Field(default_factory=utc_now)


class ArmFault(_Line):
    """The arm failed, or was not confirmed to be at rest at the end of a session."""

    event: Literal["fault"] = "fault"
    message: str
    run: str = ""
    id: str = ""
    """The id is the same in each place. It is empty in version 0.1, and for a line that cannot be read."""


class Confirmation(_Line):
    """A person's statement that the cause of all faults so far is found and that the arm may move again."""

    event: Literal["confirmed"] = "confirmed"
    name: str
    note: str = ""
    faults: tuple[str, ...] = ()
    """Ids of the faults that it is about, in addition to all earlier faults in its file."""


class SessionOfArm(_Line):
    """The begin of the first session after a confirmation."""

    event: Literal["session"] = "session"
    run: str = ""


Line: TypeAlias = ArmFault | Confirmation | SessionOfArm
_LINE: TypeAdapter[Line] = TypeAdapter(Annotated[Line, Field(discriminator="event")])


class ArmFaults:
    """The faults of one cell's arm."""

    def __init__(self, *folders: Path) -> None:
        """`folders` are all places of the arm."""
        self._paths = tuple(folder / "arm.jsonl" for folder in folders)

    @property
    def where(self) -> str:
        """The files' paths, for messages when their disk does not answer."""
        return ", ".join(map(str, self._paths))

    def standing(self) -> list[ArmFault]:
        """Faults that nobody has confirmed yet, oldest first. A line that cannot be read counts as one."""
        files = [_lines(path) for path in self._paths]
        confirmed_ids = {
            fault_id
            for lines in files
            for line in lines
            if isinstance(line, Confirmation)
            for fault_id in line.faults
        }
        faults: dict[tuple[str, str], ArmFault] = {}
        for lines in files:
            for fault in _unconfirmed_faults(lines):
                if not fault.id or fault.id not in confirmed_ids:
                    faults.setdefault((fault.t, fault.id or fault.message), fault)
        return sorted(faults.values(), key=lambda fault: fault.t)

    def refuse(self, rig: Path) -> None:
        """Raise DeviceFault if a fault stands. `rig` is the file that the message names."""
        if standing := self.standing():
            raise DeviceFault(
                "robot",
                expected="a confirmation by a person who has been to the cell",
                happened=f"since {standing[-1].t} the arm has a fault: {standing[-1].message.rstrip('.')}",
                remedy=f"Find the cause, check that the cell is clear, then give `coupole confirm {rig} --name "
                "NAME` (`--yes` is not enough).",
            )

    def note(self, message: str, run: str = "") -> None:
        """Note a fault; it is synced when this returns. Raises StorageError if one of the places does not take
        it."""
        self._append(ArmFault(message=message, run=run, id=uuid.uuid4().hex))

    def confirm(self, name: str, note: str = "") -> None:
        """Confirm all standing faults."""
        fault_ids = tuple(fault.id for fault in self.standing() if fault.id)
        self._append(Confirmation(name=name, note=note, faults=fault_ids))

    def begin_session(self, run: str) -> str:
        """Note that a session of this run begins. Return the newest confirmation if no earlier session has begun
        with it, otherwise an empty text."""
        files = [_lines(path) for path in self._paths]
        words = next((confirmation for lines in files if (confirmation := _new_words(lines)) is not None), None)
        if words is None:
            return ""
        self._append(SessionOfArm(run=run))
        faults = [line for lines in files for line in lines if isinstance(line, ArmFault)]
        last = max(faults, key=lambda fault: fault.t).message if faults else "no fault"
        return f"{last} (confirmed by {words.name}, {words.t})"

    def _append(self, line: _Line) -> None:
        """Append the line in all places, even if one of them does not take it."""
        failures = [error for path in self._paths if (error := _append_to(path, line)) is not None]
        if failures:
            raise failures[0]


def faults_of(cell: Cell, identity: Identity | None = None) -> ArmFaults:
    """Return the faults of a cell's arm. Give its `identity` if the arm is opened."""
    return ArmFaults(*places_of_arm(cell, identity))


def _unconfirmed_faults(lines: list[Line]) -> list[ArmFault]:
    """Return the faults after the last confirmation in the same file."""
    faults: list[ArmFault] = []
    for line in lines:
        if isinstance(line, ArmFault):
            faults.append(line)
        elif isinstance(line, Confirmation):
            faults.clear()
    return faults


def _new_words(lines: list[Line]) -> Confirmation | None:
    """Return the newest confirmation with which no session has begun yet."""
    since = max((i for i, line in enumerate(lines) if isinstance(line, SessionOfArm)), default=-1) + 1
    return next((line for line in reversed(lines[since:]) if isinstance(line, Confirmation)), None)


def _append_to(path: Path, line: _Line) -> StorageError | None:
    try:
        make_folder(path.parent)
    except OSError as error:
        return StorageError(f"{path.parent}: cannot be made: {error.strerror}")
    try:
        file = LineFile(path)
        try:
            file.append([line.model_dump_json() + "\n"])
        finally:
            file.close()
    except StorageError as error:
        return error
    return None


def _lines(path: Path) -> list[Line]:
    """Return all lines, oldest first. A line that cannot be read counts as a fault, because it may have been
    one."""
    try:
        texts = path.read_bytes().splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path}: cannot read the faults of the arm: {error.strerror}") from error
    return [_parse_line(text) for text in texts]


def _parse_line(text: bytes) -> Line:
    try:
        return _LINE.validate_json(text)
    except ValidationError:
        return ArmFault(t="an unknown time", message="a line of the record of the arm's faults cannot be read")

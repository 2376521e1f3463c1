"""Faults of a cell's arm, and the words of those who have been there: `arm.jsonl` in the cell's state folder.

A fault belongs to the cell, not to the run in which it happened: until a named person confirms that the cause is
found and the cell is clear, no session of any run may move that arm.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from coupole.errors import DeviceFault, StorageError
from coupole.storage.line_file import LineFile, utc_now


class _Line(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")

    t: str = Field(default_factory=utc_now)


class ArmFault(_Line):
    """The arm failed, or was not confirmed to be at rest at the end of a session."""

    event: Literal["fault"] = "fault"
    message: str
    run: str = ""


class Confirmation(_Line):
    """A person's word that the cause of all faults so far is found and that the arm may move again."""

    event: Literal["confirmed"] = "confirmed"
    name: str
    note: str = ""


class SessionOfArm(_Line):
    """The first session after a confirmation has begun."""

    event: Literal["session"] = "session"
    run: str = ""


_LINE: TypeAdapter[ArmFault | Confirmation | SessionOfArm] = TypeAdapter(
    Annotated[ArmFault | Confirmation | SessionOfArm, Field(discriminator="event")]
)


class ArmFaults:
    """The faults of one cell's arm."""

    def __init__(self, state_folder: Path) -> None:
        self.path = state_folder / "arm.jsonl"

    def lines(self) -> list[ArmFault | Confirmation | SessionOfArm]:
        """All lines, oldest first. A line that cannot be read counts as a fault: it may have been one."""
        try:
            texts = self.path.read_bytes().splitlines()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StorageError(f"{self.path}: cannot read the faults of the arm: {error.strerror}") from error
        return [_read(text) for text in texts]

    def standing(self) -> list[ArmFault]:
        """Faults that nobody has confirmed yet."""
        found: list[ArmFault] = []
        for line in self.lines():
            if isinstance(line, ArmFault):
                found.append(line)
            elif isinstance(line, Confirmation):
                found.clear()
        return found

    def refuse(self, rig: Path) -> None:
        """Raise DeviceFault if a fault stands. `rig` is the file that the message names."""
        if standing := self.standing():
            raise DeviceFault(
                "robot",
                expected="the word of a person who has been to the cell",
                happened=f"since {standing[-1].t} the arm is in a fault: {standing[-1].message}",
                remedy=f"Find the cause, see that the cell is clear, then say `coupole confirm {rig} --name NAME` "
                "(`--yes` does not).",
            )

    def note(self, message: str, run: str = "") -> None:
        """A fault, synced when this returns."""
        self._append(ArmFault(message=message, run=run))

    def confirm(self, name: str, note: str = "") -> None:
        self._append(Confirmation(name=name, note=note))

    def begin_session(self, run: str) -> str:
        """A session of this run begins; returns the words that no earlier session has begun with, empty if there
        are none."""
        lines = self.lines()
        since = max((i for i, line in enumerate(lines) if isinstance(line, SessionOfArm)), default=-1) + 1
        faults = [line.message for line in lines if isinstance(line, ArmFault)]
        words = [line for line in lines[since:] if isinstance(line, Confirmation)]
        if not words:
            return ""
        self._append(SessionOfArm(run=run))
        return f"{faults[-1] if faults else 'no fault'} (confirmed by {words[-1].name}, {words[-1].t})"

    def _append(self, line: _Line) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"{self.path.parent}: cannot be made: {error.strerror}") from error
        file = LineFile(self.path)
        try:
            file.append([line.model_dump_json() + "\n"])
        finally:
            file.close()


def _read(text: bytes) -> ArmFault | Confirmation | SessionOfArm:
    try:
        return _LINE.validate_json(text)
    except ValidationError:
        return ArmFault(t="an unknown time", message="a line of the record of its faults cannot be read")

"""The record of a cell's commissioning: `commissioning.yaml`, and whether it fits the cell. It is kept in the
place of the arm's controller, and in the rig's state folder (`coupole.plan.controller_places`).

Each step keeps all settings of the rig that it covers (`commissioned_rig`), and the devices with which it was
done. So after a change of the rig, or with another box, only the steps that it concerns must be repeated. The file
carries a SHA-256 of its own content, as calibrations do.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, JsonValue

import coupole
from coupole.calibration.record import Limit, Sha256, content_sha256, write_sealed
from coupole.devices import Identity
from coupole.errors import InputError, StorageError, reason
from coupole.plan import yamlfile
from coupole.plan.base_model import Model, Name
from coupole.plan.cell import Cell
from coupole.plan.controller_places import places_of_arm
from coupole.plan.rig_devices import in_world
from coupole.preflight.commissioned_rig import STEPS, Step, covered_settings

__all__ = ["STEPS", "Step"]
_DEVICES: Mapping[Step, tuple[str, ...]] = {
    "cycle": ("robot",),
    "axes": ("robot",),
    "stopping": ("robot",),
    "geometry": ("robot", "camera"),
    "lamps": ("ledbox",),
    "trigger": ("ledbox", "camera"),
    "watchdog": ("ledbox",),
    "presence": ("ledbox",),
    "emergency-stop": ("robot",),
}
"""The devices that each step is about."""
_MOST_TOLD = 8
_FILE = "commissioning.yaml"
_HEAD = "# The commissioning of a cell. It carries its own checksum: do not edit it, use `coupole commission`."


class Answer(Model):
    """A question to the person, and whether the answer was yes."""

    question: str
    yes: bool


class StepResult(Model):
    """One step, and how it ended."""

    step: Step
    person: Annotated[str, Field(min_length=1)]
    ended: AwareDatetime
    devices: dict[str, str]
    """Vendor, model, serial number and firmware of each device of the step."""
    settings: dict[str, JsonValue]
    """All settings of the rig that the result depends on, by their place in the rig."""
    covers: Literal["everything"] | None = Field(default=None, exclude_if=lambda value: value is None)
    """None in a record of a version that kept only some of the settings."""
    limits: tuple[Limit, ...]
    answers: tuple[Answer, ...]
    remarks: tuple[str, ...]
    failure: str = ""
    """Failure and what to do about it; empty if nothing was wrong."""

    @property
    def has_passed(self) -> bool:
        return (
            not self.failure
            and all(limit.is_met for limit in self.limits)
            and all(answer.yes for answer in self.answers)
        )


class CommissioningRecord(Model):
    """The newest result of each step."""

    schema_version: Literal[1]
    kind: Literal["commissioning"]
    rig: Name
    software: str
    simulated: bool
    steps: tuple[StepResult, ...]
    sha256: Sha256

    def result(self, step: Step) -> StepResult | None:
        return next((step_result for step_result in self.steps if step_result.step == step), None)

    @property
    def has_passed(self) -> bool:
        """True if every step was done and passed."""
        return all((step_result := self.result(step)) is not None and step_result.has_passed for step in STEPS)

    def with_result(self, result: StepResult) -> CommissioningRecord:
        """Return the same record with a new result in place of the older result of that step."""
        results = {step_result.step: step_result for step_result in self.steps} | {result.step: result}
        return _sealed_record(
            self.rig, tuple(results[step] for step in STEPS if step in results), is_simulated=self.simulated
        )


def record_path(cell: Cell) -> Path:
    """Return the record's path in the rig's state folder; copies are in the other places of the arm."""
    return cell.state_folder / _FILE


def empty_record(cell: Cell) -> CommissioningRecord:
    return _sealed_record(cell.rig.name, (), is_simulated=in_world(cell.rig, dry_run=False))


def read_commissioning(cell: Cell) -> CommissioningRecord | None:
    """Return the cell's record, from the place of its arm's controller and from the rig's state folder; None if
    there is none.

    For each step the newest result that fits the rig is taken. If none fits, it is the newest result. Raises
    InputError for a record that was edited or cannot be read, StorageError if its folder cannot be entered.
    """
    paths = [place / _FILE for place in places_of_arm(cell)]
    records = {path: _read_record(path) for path in paths if _is_there(path)}
    is_simulated = in_world(cell.rig, dry_run=False)
    own_records = {path: record for path, record in records.items() if record.simulated == is_simulated}
    if not own_records:
        return next(iter(records.values()), None)
    if list(own_records) == [record_path(cell)]:
        return own_records[record_path(cell)]
    steps = []
    for step in STEPS:
        results = [
            step_result for record in own_records.values() if (step_result := record.result(step)) is not None
        ]
        fitting = [result for result in results if not why_outdated(cell, result)]
        steps += sorted(fitting or results, key=lambda result: result.ended)[-1:]
    return _sealed_record(cell.rig.name, tuple(steps), is_simulated=is_simulated)


def _is_there(path: Path) -> bool:
    """Tell whether a record exists. Raises StorageError if this cannot be determined."""
    try:
        return path.exists()
    except OSError as error:
        raise StorageError(f"{path}: cannot read the record of the commissioning: {reason(error)}") from error


def _read_record(path: Path) -> CommissioningRecord:
    document = yamlfile.read_document(path)
    record = document.validate(CommissioningRecord)
    if content_sha256(json.loads(record.model_dump_json())) != record.sha256:
        message = "the record was edited after it was made: its content has another checksum. Commission anew"
        raise InputError([document.problem(("sha256",), message)])
    return record


def write_commissioning(cell: Cell, record: CommissioningRecord) -> None:
    """Write the record in all places of the arm. Raises StorageError."""
    for place in places_of_arm(cell):
        write_sealed(place / _FILE, json.loads(record.model_dump_json()), _HEAD)


def settings_of(cell: Cell, step: Step) -> dict[str, JsonValue]:
    """Return all settings of the rig that the result of a step depends on."""
    plain: dict[str, JsonValue] = json.loads(json.dumps(covered_settings(cell, step)))
    return plain


def devices_of(step: Step, identities: Mapping[str, Identity]) -> dict[str, str]:
    """Return the devices of a step, as its result keeps them."""
    return {
        kind: " ".join(
            filter(
                None,
                (
                    identity.vendor,
                    identity.model,
                    identity.serial,
                    f"({identity.firmware})" if identity.firmware else "",
                ),
            )
        )
        for kind in _DEVICES[step]
        for identity in (identities[kind],)
    }


def why_outdated(cell: Cell, result: StepResult, identities: Mapping[str, Identity] | None = None) -> str:
    """Return why a step's result does not fit the rig (and the opened devices) any more; empty if it still
    fits."""
    before, now = result.settings, settings_of(cell, result.step)
    lacking = []
    if result.covers is None:
        if places := _places(key for key in now if key not in before):
            lacking = [f"an earlier version did this step, and did not cover {places}"]
        before, now = ({key: fingerprints[key] for key in before if key in now} for fingerprints in (before, now))
    changes = _changes(before, now)
    if identities is not None:
        changes += _changes(result.devices, devices_of(result.step, identities))
    more = len(changes) - _MOST_TOLD
    return "; ".join([*changes[:_MOST_TOLD], *([f"and {more} more"] if more > 0 else []), *lacking])


def commissioning_refusals(cell: Cell, identities: Mapping[str, Identity] | None = None) -> list[str]:
    """Return why a cell that is not simulated must not be used. Either a step of its commissioning is missing, has
    failed or does not fit the rig any more, or the opened devices are different ones. The list is empty for a
    simulated cell."""
    if in_world(cell.rig, dry_run=False):
        return []
    command = f"coupole commission {cell.document.path} --name NAME"
    try:
        record = read_commissioning(cell)
    except InputError as error:
        return [f"commissioning: {error}; remove the file and run `{command}`"]
    if record is None:
        return [f"commissioning: this cell has no record ({record_path(cell)}). At the cell, say `{command}`"]
    if record.simulated:
        return [f"commissioning: {record_path(cell)} was made with a simulated cell. Say `{command}`"]
    refusals = []
    for step in STEPS:
        result = record.result(step)
        if result is None:
            why = f"it covers {_places(settings_of(cell, step))}"
            refusals.append(f"commissioning: the step {step} was not done; {why}. Say `{command}`")
        elif not result.has_passed:
            refusals.append(f"commissioning: the step {step} did not pass. Say `{command}`")
        elif why := why_outdated(cell, result, identities):
            refusals.append(f"commissioning: the step {step} does not fit any more: {why}. Say `{command}`")
    return refusals


def _places(keys: Iterable[str]) -> str:
    return ", ".join(sorted({key.partition(".")[0] for key in keys}))


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [
        f"{key} is {_short(now.get(key))}, was {_short(before.get(key))}"
        for key in sorted({*before, *now})
        if before.get(key) != now.get(key)
    ]


def _short(value: Any) -> str:
    text = "absent" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:12]}..."


def _sealed_record(rig: str, steps: tuple[StepResult, ...], *, is_simulated: bool) -> CommissioningRecord:
    record = CommissioningRecord.model_construct(
        schema_version=1,
        kind="commissioning",
        rig=rig,
        software=f"coupole {coupole.__version__}",
        simulated=is_simulated,
        steps=steps,
        sha256="",
    )
    plain = json.loads(record.model_dump_json())
    return CommissioningRecord.model_validate_json(json.dumps({**plain, "sha256": content_sha256(plain)}))

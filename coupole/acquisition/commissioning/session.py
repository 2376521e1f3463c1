"""One `coupole commission`: runs the steps that are due, and keeps each in the cell's record as soon as it has
ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from coupole.acquisition.commissioning import (
    arm_steps,
    emergency_stop,
    geometry_step,
    lamp_step,
    light_timing,
    presence_step,
)
from coupole.acquisition.commissioning.bench import Bench, Findings, Person, StepFailedError
from coupole.acquisition.commissioning.reduced_speed import REDUCED_MM_S, at_reduced_speed, greatest_speeds_deg_s
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell, open_cell
from coupole.acquisition.operator import identity_printer
from coupole.acquisition.signals import obeyed_by
from coupole.bounded import run_bounded
from coupole.errors import CommissioningFailed, DeviceError, InputError
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import bodies_of
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import in_world
from coupole.preflight import commissioning_page
from coupole.preflight.commissioned import (
    STEPS,
    CommissioningRecord,
    Step,
    StepResult,
    devices_of,
    empty_record,
    read_commissioning,
    record_path,
    settings_of,
    why_outdated,
    write_commissioning,
)
from coupole.storage.arm_faults import faults_of
from coupole.viewing.terminal import alarm, step_bars

ACTS: Mapping[Step, Callable[[Bench], None]] = {
    "cycle": arm_steps.cycle,
    "axes": arm_steps.axes,
    "stopping": arm_steps.stopping,
    "geometry": geometry_step.geometry,
    "lamps": lamp_step.lamps,
    "trigger": light_timing.trigger,
    "watchdog": light_timing.watchdog,
    "presence": presence_step.presence,
    "emergency-stop": emergency_stop.emergency_stop,
}
_BEGIN = (
    "Commissioning. You need: mode T1 at the controller with one hand on the enabling switch; the emergency stop "
    "in "
    "reach; nobody in the cell; no object in the dome that light or arm can harm. No point of the arm is faster "
    "than "
    f"{REDUCED_MM_S:g} mm/s. The arm moves a few degrees about where it stands: it must have room there, and its "
    "camera must see a matte ball on the support."
)


def commission(
    cell: Cell,
    console: Console,
    *,
    name: str,
    only: Step | None,
    person_at: Callable[[OpenedCell, Control], Person],
    board: Path | None = None,
) -> CommissioningRecord:
    """Do the steps that are due, or `only` one; returns the record.

    `name` is the person's name; `person_at` gives the person for the opened cell and the session's control.
    `board` is the file that describes the board of the step geometry. A step is due if it was not done, did not
    pass, or does not fit the rig and its devices any more. Raises CommissioningFailed after the first step that
    does not pass, DeviceError if a device fails, Interrupted if the person does not go on.
    """
    faults_of(cell).refuse(cell.document.path)
    bodies = bodies_of(cell.rig, cell.leds, np.zeros((0, 3, 3)), cell.link_meshes, cell.files)
    slow = replace(cell, rig=at_reduced_speed(cell.rig, bodies))
    record = _record_so_far(cell, console)
    control = Control()
    with open_cell(slow, on_opened=identity_printer(console)) as opened_cell:
        faults_of(cell, opened_cell.identities["robot"]).refuse(cell.document.path)
        record = _record_so_far(cell, console)  # of this controller, wherever it was reached before
        bench = replace(
            run_bounded(lambda: _bench(slow, opened_cell, bodies, person_at(opened_cell, control), control)),
            bars=lambda: step_bars(console),
            board=board,
        )
        due = [only] if only else _due(cell, record, opened_cell)
        if not due:
            console.print("every step has passed and fits this cell; `--only STEP` repeats one")
        try:
            with obeyed_by(control, opened_cell.halt):
                if due:
                    bench.ask_before(_BEGIN)
                for step in due:
                    do = partial(_run_step, step, bench, cell, name)
                    result, failure = run_bounded(do, stop=control.stop, rescue=opened_cell.make_safe)
                    record = record.with_result(result)
                    write_commissioning(cell, record)
                    commissioning_page.write(record_path(cell), record)
                    _say(console, result)
                    if failure is not None:
                        raise failure
                    if not result.has_passed:
                        raise CommissioningFailed(step, shortcomings(result))
        except DeviceError as error:
            if error.device == "robot":
                faults_of(cell, opened_cell.identities["robot"]).note(str(error), "commissioning")
            raise
        finally:
            opened_cell.make_safe()
            for trouble in opened_cell.trouble:
                alarm(trouble)
            if not opened_cell.arm_confirmed:
                faults_of(cell, opened_cell.identities["robot"]).note(
                    "; ".join(opened_cell.trouble), "commissioning"
                )
    return record


def shortcomings(result: StepResult) -> list[str]:
    """Return in words what failed in a step."""
    sentences = [
        f"{entry.what}: {entry.found:.4g} {entry.unit}, at most {entry.limit:.4g}".replace(" ,", ",")
        for entry in result.limits
        if not entry.is_met
    ]
    sentences += [f"answered with no: {entry.question}" for entry in result.answers if not entry.yes]
    return [*sentences, *([result.failure] if result.failure else [])]


def _bench(cell: Cell, opened_cell: OpenedCell, bodies: CellBodies, person: Person, control: Control) -> Bench:
    return Bench(cell, opened_cell, bodies, greatest_speeds_deg_s(cell.rig), person, control)


def _record_so_far(cell: Cell, console: Console) -> CommissioningRecord:
    record = read_commissioning(cell)
    is_simulated = in_world(cell.rig, dry_run=False)
    if record is None:
        return empty_record(cell)
    if (record.rig, record.simulated) != (cell.rig.name, is_simulated):
        kind = "simulated" if record.simulated else "real"
        raise InputError(
            f"{record_path(cell)}: is the record of the {kind} cell {record.rig}; expected the record "
            f"of {cell.rig.name}. Give "
            "each cell its own `storage: state:`, or move the file away"
        )
    return record


def _due(cell: Cell, record: CommissioningRecord, opened_cell: OpenedCell) -> list[Step]:
    results = {step: record.result(step) for step in STEPS}
    return [
        step
        for step, result in results.items()
        if result is None or not result.has_passed or why_outdated(cell, result, opened_cell.identities)
    ]


def _run_step(step: Step, bench: Bench, cell: Cell, name: str) -> tuple[StepResult, DeviceError | None]:
    """Do one step. Returns its result, and the device's error if one ended the step. Raises Interrupted if the
    person stopped the step, or if this process did not run for a while: this is no result."""
    findings = bench.findings = Findings()
    failure, error = "", None
    try:
        with bench.control.explains(DeviceError, StepFailedError):
            ACTS[step](bench)
    except StepFailedError as shortcoming:
        failure = str(shortcoming)
    except DeviceError as raised:
        failure, error = str(raised), raised
    if not findings.has_passed:
        bench.control.go_on()  # the stop may have spoilt the figures
    result = StepResult(
        step=step,
        person=name,
        ended=datetime.now(UTC),
        devices=devices_of(step, bench.opened.identities),
        settings=settings_of(cell, step),
        covers="everything",
        limits=tuple(findings.limits),
        answers=tuple(findings.answers),
        remarks=tuple(findings.remarks),
        failure=failure,
    )
    if not result.has_passed and not failure:
        result = result.model_copy(update={"failure": findings.remedy})
    return result, error


def _say(console: Console, result: StepResult) -> None:
    console.print(f"{result.step}: {'passed' if result.has_passed else 'NOT PASSED'}", markup=False)
    for line in (*result.remarks, *(shortcomings(result) if not result.has_passed else ())):
        console.print(f"  {line}", markup=False)

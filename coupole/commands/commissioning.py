"""The command that commissions a cell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, fail, person_named
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from coupole.plan.cell import Cell


_Only = Annotated[
    str | None,
    typer.Option(
        "--only",
        help="Do this step even if it has passed: cycle, axes, stopping, geometry, lamps, trigger, "
        "watchdog, presence or emergency-stop.",
    ),
]
_Board = Annotated[
    Path | None,
    typer.Option(
        "--board",
        help="The board of the step geometry (YAML, as for calibrate camera); 11 x 8 corners of 16 mm, markers of "
        "9.6 mm, if not given.",
        show_default=False,
    ),
]


def commission(
    rig: Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)],
    name: Annotated[str, typer.Option("--name", help="Name of the person at the cell.", show_default=False)],
    only: _Only = None,
    board: _Board = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask; for simulated cells only.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure a cell's safety figures at reduced speed, step by step; a person confirms before each step.

    The record is in the cell's state folder. A real cell runs plans only with a record that passed and fits the
    cell. Steps that passed are not repeated. Exit code 3: a step did not pass.
    """
    from coupole.acquisition.commissioning.persons import PersonAtTerminal, SimulatedPerson
    from coupole.acquisition.commissioning.session import commission as commission_cell
    from coupole.calibration.lens.board import read_board
    from coupole.console.command_line.client import borrowed_cell
    from coupole.plan.cell import read_cell
    from coupole.plan.rig_devices import in_world
    from coupole.preflight.commissioned import STEPS, record_path
    from coupole.viewing.terminal import make_console

    name = person_named(name, "the person at the cell")
    step = next((entry for entry in STEPS if entry == only), None)
    if only is not None and step is None:
        raise InputError(f"--only: expected one of {', '.join(STEPS)}; found {only!r}")
    if board is not None:
        read_board(board)
    console, cell = make_console(quiet=as_json), read_cell(rig)
    if not in_world(cell.rig, dry_run=False):
        _refuse_without_person(rig, yes=yes)

    try:
        with borrowed_cell(cell, f"commission, {name}"):
            record = commission_cell(
                cell,
                console,
                name=name,
                only=step,
                board=board,
                person_at=lambda opened_cell, control: (
                    SimulatedPerson(console, opened_cell.world_endpoints)
                    if yes and opened_cell.world_endpoints is not None
                    else PersonAtTerminal(control)
                ),
            )
    except CoupoleError as error:
        fail(error, as_json=as_json, figures=None if isinstance(error, InputError) else _figures(cell))
        raise
    remaining_steps = [
        entry for entry in STEPS if (result := record.result(entry)) is None or not result.has_passed
    ]
    console.print(f"record  {record_path(cell)}", markup=False)
    console.print(
        f"still to be done: {', '.join(remaining_steps)}" if remaining_steps else "the cell is commissioned",
        markup=False,
    )
    if as_json:
        print(json.dumps(_figures(cell)))


def _refuse_without_person(rig: Path, *, yes: bool) -> None:
    """Raise InputError unless a person answers here. `rig` is the file of a real cell."""
    from coupole.viewing.questions import is_asked_at_a_terminal

    if yes:
        raise InputError(f"--yes: {rig} is a real cell, where a person must see and answer; leave --yes out")
    if not is_asked_at_a_terminal():
        raise InputError(
            f"{rig} is a real cell, where a person must see and answer: type the command at a terminal; its "
            f"standard input is not a terminal"
        )


def _figures(cell: Cell) -> dict[str, Any]:
    """The figures of `--json`."""
    from coupole.preflight.commissioned import read_commissioning, record_path

    record = read_commissioning(cell)
    return {
        "record": str(record_path(cell)),
        "passed": bool(record and record.has_passed),
        "steps": {result.step: result.has_passed for result in (record.steps if record else ())},
    }

"""The light that an object has received: `coupole dose`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, person_named
from coupole.errors import InputError

if TYPE_CHECKING:
    from coupole.plan.cell import Cell


def dose(
    object_id: Annotated[
        str, typer.Argument(metavar="OBJECT", help="The object's id in plans.", show_default=False)
    ],
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Rig whose ledgers are used; by default the user's data folder.")
    ] = None,
    add: Annotated[
        float | None,
        typer.Option("--add", min=0, help="Enter light that was given elsewhere, in lux hours; needs --note."),
    ] = None,
    note: Annotated[str, typer.Option("--note", help="Description of that light.")] = "",
    warn_above: Annotated[
        float | None, typer.Option("--warn-above", min=0, help="Warn when the total exceeds this, in lux hours.")
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            "--budget",
            min=0,
            help="Largest total light that the object may receive in its life, in lux hours; needs --name.",
        ),
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Name of the person who decides the budget.")] = "",
    reason: Annotated[str, typer.Option("--reason", help="Reason for this budget.")] = "",
    as_json: JsonOption = False,
) -> None:
    """All light that an object has received, run by run, and its budget; light given elsewhere is entered by hand.

    The budget applies to every rig and plan from the next burst on. A plan's own budget can only be stricter.
    """
    from coupole.plan.cell import read_cell, users_ledger_folder
    from coupole.storage.ledger import Ledger, ledger_of, similar_ids
    from coupole.viewing.dose_table import document, show_dose
    from coupole.viewing.terminal import make_console

    if (add is not None) != bool(note.strip()):
        raise InputError("--add and --note belong together: the lux hours, and a note about the light")
    if (budget is not None) != bool(name.strip()) or (reason.strip() and budget is None):
        raise InputError(
            "--budget and --name belong together (and --reason to them): the lux hours, and the person who decides"
        )
    cell = read_cell(rig) if rig else None
    ledger = ledger_of(cell, object_id) if cell else Ledger(users_ledger_folder(), object_id)
    is_new = ledger.read_history().is_empty
    if add is not None and not _entered_by_console(
        cell, object_id, "light", {"dose_lux_h": add, "note": note.strip()}
    ):
        ledger.enter(add, note.strip())
    if warn_above is not None and not _entered_by_console(cell, object_id, "warning", {"above_lux_h": warn_above}):
        ledger.warn_above(warn_above)
    person = person_named(name, "who says so") if budget is not None else ""
    request = {"dose_lux_h": budget, "name": person, "reason": reason.strip()}
    if budget is not None and not _entered_by_console(cell, object_id, "budget", request):
        ledger.set_budget(budget, person, reason)
    history, similar_objects = ledger.read_history(), similar_ids(ledger.folder, object_id)
    show_dose(make_console(quiet=as_json), ledger, history, similar_objects, is_new=is_new)
    if as_json:
        print(json.dumps(document(ledger, history, similar_objects)))


def _entered_by_console(cell: Cell | None, object_id: str, resource: str, body: dict[str, Any]) -> bool:
    """Return True if the cell's console has made the entry, which then names the person who is signed in; False if
    no console is served. Raises InputError if the console refuses the entry."""
    from coupole.console.command_line.client import NotServed, call

    try:
        if cell is not None:
            call(cell, "POST", f"/api/v1/objects/{object_id}/{resource}", body)
    except NotServed:
        return False
    return cell is not None

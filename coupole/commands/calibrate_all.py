"""`coupole calibrate all`: all calibrations of a cell, in order."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from coupole.calibration.campaign_steps import MESH, STEPS
from coupole.commands.calibrate_geometry import RepeatabilityDeg, RepeatabilityMm
from coupole.commands.campaign import Campaign, Operator, Repeatability
from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError


def calibrate_all(
    rig: Annotated[Path, typer.Option("--rig", help="The rig (YAML).")] = Path("sim-imperfect"),
    out: Annotated[Path, typer.Option("--out", help="Folder for plans, runs, records and reports.")] = Path(
        "calibrations"
    ),
    scan: Annotated[
        Path | None,
        typer.Option("--scan", help="Folder of `coupole scan` with the mesh of the object and its stickers."),
    ] = None,
    repeatability_mm: RepeatabilityMm = 0.03,
    repeatability_deg: RepeatabilityDeg = 0.003,
    only: Annotated[list[str] | None, typer.Option("--only", help="Do this step only; repeat for more.")] = None,
    valid_days: Annotated[
        int | None, typer.Option("--valid-days", min=1, max=3650, help="Days until the records expire.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before each step of a real cell.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Acquire and calibrate each of: dark frames, response, flat field, lens and hand-eye, LEDs and their power,
    an object's place.

    A step with a record in the folder is skipped, and an interrupted run is resumed: to finish, give the command
    again. For a real cell the command prints what must be on the support, and waits; a simulated cell has its own
    object and scanner.
    """
    from coupole.console.command_line.client import borrowed_cell
    from coupole.plan.cell import read_cell
    from coupole.plan.rig_devices import in_world
    from coupole.plan.shipped_files import file_of
    from coupole.viewing.terminal import make_console

    rig = file_of(rig, "rigs")
    console, cell = make_console(quiet=as_json), read_cell(rig)
    names = [step.name for step in STEPS]
    if unknown := [name for name in only or [] if name not in names]:
        raise InputError(f"--only {unknown[0]}: expected one of {', '.join(names)}")
    is_simulated = in_world(cell.rig, dry_run=False)
    if not is_simulated and scan is None:
        if MESH in (only or []):
            raise InputError(f"--only {MESH}: needs the object's scan, as `coupole scan` writes it: --scan FOLDER")
        names.remove(MESH)
        console.print(f"{MESH}: skipped, as no --scan is given")
    repeatability = Repeatability(repeatability_mm, repeatability_deg)
    operator = Operator(console, is_asked=not yes and not is_simulated)
    campaign = Campaign(rig, out, scan, repeatability, operator, is_simulated=is_simulated, valid_days=valid_days)
    try:
        with borrowed_cell(cell, "calibrate all"):
            campaign.do_all(only or names)
    except CoupoleError as error:
        fail(error, as_json=as_json, figures={"records": campaign.record_paths()})
        raise
    if as_json:
        print(json.dumps({"records": campaign.record_paths()}))
    for kind, record in campaign.record_paths().items():
        console.print(f"[green]{kind}[/]: {record}")
    console.print(
        f"To put these records in force for all plans of {rig}, write in that "
        f"file:\n{_for_a_rig(rig, campaign.record_paths())}"
    )


def _for_a_rig(rig: Path, records: dict[str, str]) -> str:
    """Return the rig's lines that name the records of the cell, without the records of an object."""
    folder = rig.resolve().parent
    paths = [os.path.relpath(path, folder) for kind, path in records.items() if kind != MESH]
    return "\n".join(["calibrations:", *(f"  - {path}" for path in paths)])

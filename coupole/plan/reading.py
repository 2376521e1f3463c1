"""Reads a plan and the files that it names together, and reports all mistakes in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from coupole.errors import InputError, Problem
from coupole.intake.input_files import InputFiles
from coupole.plan import yamlfile
from coupole.plan.base_model import possible_path
from coupole.plan.cell import Cell, read_cell
from coupole.plan.light_selection import missing_lights
from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.plan.schedule import names_too_long, too_large
from coupole.plan.shipped_files import file_of
from coupole.plan.yamlfile import Document


@dataclass(frozen=True)
class PlanFiles:
    """A plan as written, with its cell, and with the paths of the other files that it names."""

    plan: Plan
    document: Document
    cell: Cell
    mesh_path: Path | None
    """The object's mesh; the file exists."""
    record_paths: tuple[Path, ...] | None
    """The calibrations that plan or rig name as in force; None if `none`."""


def read_plan(plan_path: Path, rig_path: Path | None = None, *, text: str | None = None) -> PlanFiles:
    """Read a plan with its rig, or with another rig. With `text`, the text is read instead of the plan's file.
    Names of shipped plans and rigs may be given. Raises InputError with all problems of all files."""
    files = InputFiles()
    plan_path = file_of(plan_path, "plans")
    document = yamlfile.read_document(plan_path, files) if text is None else yamlfile.parse(plan_path, text)
    plan, problems = document.problems(Plan)
    cell: Cell | None = None
    rig_path = file_of(rig_path, "rigs") if rig_path else _named_rig(document)
    if rig_path is not None and not rig_path.is_file():
        problems.append(document.problem(("rig",), f"expected a rig file; there is no {rig_path}"))
    elif rig_path is not None:
        try:
            cell = read_cell(rig_path, files)
        except InputError as error:
            problems += error.problems
    if plan is None or cell is None:
        raise InputError(problems)
    if cell.rig.arm is None:
        message = (
            f"expected the file of the arm that `{cell.rig.robot.driver}` moves: preflight must know what "
            "the arm could touch"
        )
        problems.append(cell.document.problem(("arm",), message))
    wrong = missing_lights(plan, cell.leds, cell.rig.support.base_from_support.matrix())
    wrong += names_too_long(plan, cell.leds)
    wrong += too_large(plan, cell.leds)
    problems += [document.problem(key, message) for key, message in wrong]
    mesh_path = document.resolve(plan.object.mesh) if plan.object and plan.object.mesh else None
    if mesh_path is not None and not files.there(mesh_path):
        message = f"expected a mesh file (PLY, STL, OBJ); there is no {mesh_path}"
        problems.append(document.problem(("object", "mesh"), message))
    record_paths, missing = _named_records(document, plan, cell)
    problems += missing
    problems += _bad_exposures(document, plan, cell.rig)
    if problems:
        raise InputError(problems)
    return PlanFiles(plan, document, cell, mesh_path, record_paths)


def _named_rig(document: Document) -> Path | None:
    rig_name = document.data.get("rig")
    try:
        named_path = possible_path(Path(rig_name)) if isinstance(rig_name, str) else None
    except ValueError:  # the plan's own problems say so
        return None
    if named_path is None or (beside := document.resolve(named_path)).is_file():
        return beside if named_path else None
    shipped_path = file_of(named_path, "rigs")
    return beside if shipped_path == named_path else shipped_path


def _named_records(document: Document, plan: Plan, cell: Cell) -> tuple[tuple[Path, ...] | None, list[Problem]]:
    """Return the files of the records that the plan names, or otherwise its rig (None for `none`), and a problem
    for each missing file."""
    record_names = plan.calibrations
    if record_names is None:
        document, record_names = cell.document, cell.rig.calibrations
    if record_names == "none":
        return None, []
    paths = tuple(document.resolve(path) for path in record_names)
    return paths, [
        document.problem(("calibrations", i), f"expected a calibration record; there is no {path}")
        for i, path in enumerate(paths)
        if not cell.files.there(path)
    ]


def _bad_exposures(document: Document, plan: Plan, rig: Rig) -> list[Problem]:
    """Return problems of exposures that do not depend on the order of the shots."""
    if plan.trigger == "software" and rig.led_limits.on_us[1] < max(plan.exposure.exposures_us):
        return [document.problem(("exposure",), "longer than the rig's LEDs may be on")]
    return []

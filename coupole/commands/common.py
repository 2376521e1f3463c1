"""Common parts of the commands: arguments and options, and errors in JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup

from coupole.acquisition.signals import SignalReceived
from coupole.commands.completion import plans, runs
from coupole.errors import CoupoleError, InputError, Interrupted

if TYPE_CHECKING:
    from coupole.plan.cell import Cell

PlanPath = Annotated[Path, typer.Argument(help="The plan (YAML).", show_default=False, autocompletion=plans)]
PlanUnlessResumed = Annotated[
    Path | None,
    typer.Argument(help="The plan (YAML); not needed with --resume.", show_default=False, autocompletion=plans),
]
RunsParentOption = Annotated[Path | None, typer.Option("--output", help="Parent folder of the run.")]
RigOption = Annotated[
    Path | None,
    typer.Option("--rig", help="A rig other than the one that the plan names: a file, or a name such as sim."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Overwrite existing files.")]
ResultArgument = Annotated[Path, typer.Argument(help="Folder of a result.", show_default=False)]
MeshOption = Annotated[
    Path | None, typer.Option("--mesh", help="Mesh of the object; by default the mesh that the run names.")
]
RecordsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--calibrations",
        help="A record (hand-eye, leds, led-power; dark, response, flat-field, glare, drift) or a folder "
        "of records; repeat for more. By default the records that the run names.",
        show_default=False,
    ),
]
RunPath = Annotated[Path, typer.Argument(help="The run's folder.", show_default=False, autocompletion=runs)]


LONGEST_NAME = 200
"""Greatest number of characters of a person's name; the console has the same limit."""


class JobOrStep(TyperGroup):
    """A group of commands with a main job: if the first word is the name of a step, that step is called; otherwise
    the words belong to the main job."""

    job: ClassVar[str]
    """Name of the main job in the list of steps; it is never typed."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [self.job, *args]
        return super().parse_args(ctx, args)


def plan_of(resumed_run: Path | None) -> Path:
    """Return the plan of a run that is resumed without naming the plan."""
    from coupole.storage.run import Run

    if resumed_run is None:
        raise typer.BadParameter("expected the plan (YAML), or --resume with a run's folder")
    return Run(resumed_run).plan_path


def served_cell(plan: Path | None, rig: Path | None, resume: Path | None) -> Cell | None:
    """Return the cell of a plan, or of a run that is resumed, if a console owns that cell; otherwise None."""
    from coupole.console.command_line.client import is_served
    from coupole.plan.cell import read_cell
    from coupole.plan.reading import read_plan
    from coupole.storage.run import Run

    if plan is not None:
        cell = read_plan(plan, rig).cell
    elif resume is not None:
        begun_with = rig or Path(Run(resume).about["rig"]["path"])
        try:
            cell = read_cell(begun_with)
        except InputError:
            if rig is not None:
                raise
            return None  # a run can be resumed from its folder alone
    else:
        return None
    return cell if is_served(cell) else None


def person_named(name: str, person_role: str) -> str:
    """Return a person's name from `--name`, without blanks around it. Raises InputError if the name is empty or
    too long.
    """
    if not (person := name.strip()):
        raise InputError(f"--name: expected the name of {person_role}")
    if len(person) > LONGEST_NAME:
        raise InputError(
            f"--name: expected a person's name of at most {LONGEST_NAME} characters; found {len(person)}"
        )
    return person


def fail(error: CoupoleError | SignalReceived, *, as_json: bool, figures: dict[str, Any] | None = None) -> None:
    """Print an error as JSON if `as_json`; the caller raises it afterwards."""
    if isinstance(error, SignalReceived):
        error = Interrupted("stopped", error.number)
    if as_json:
        document = {
            **(figures or {}),
            "error": str(error),
            "kind": type(error).__name__,
            "exit_code": error.exit_code,
        }
        print(json.dumps(document))

"""Commands on a plan, without devices: check, view, simulate, schema, plan new."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import (
    JsonOption,
    PlanPath,
    PlanUnlessResumed,
    RigOption,
    RunsParentOption,
    fail,
    plan_of,
)
from coupole.commands.completion import runs, schemas, templates
from coupole.commands.suggest_plan import plan_suggest
from coupole.errors import InputError, PreflightRefused
from coupole.plan.shipped_files import SIMULATED_CELL, file_of

plan_app = typer.Typer(help="Plans to start from.", no_args_is_help=True)
plan_app.command("suggest")(plan_suggest)


def check(
    plan: PlanUnlessResumed = None,
    rig: RigOption = None,
    output: RunsParentOption = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", help="Check the rest of this run.", autocompletion=runs)
    ] = None,
    no_paths: Annotated[
        bool, typer.Option("--no-paths", help="Leave out path planning and the collision checks along paths.")
    ] = False,
    no_disk_speed: Annotated[
        bool,
        typer.Option("--no-disk-speed", help="Do not measure the disk's write speed, because a run writes to it."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check everything about a plan that can be checked without devices."""
    from coupole.preflight.files import Files, check_files
    from coupole.viewing.preflight_table import document_of, show_preflight, show_views
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        files = Files(plan or plan_of(resume), rig, resume, output)
        job, report = check_files(files, paths=not no_paths, measure=not no_disk_speed)
    except InputError as error:
        fail(error, as_json=as_json, figures={"ok": False, "refusals": []})
        raise
    show_preflight(console, report, name=job.plan.name, rig=job.cell.rig.name)
    show_views(console, report)
    if as_json:
        print(
            json.dumps(
                {
                    **document_of(report),
                    "hidden_lights": sum(map(len, job.hidden_leds.values())),
                    "paths_checked": not no_paths,
                }
            )
        )
    if report.refusals:
        raise PreflightRefused(report.refusals)
    if not as_json:
        console.print("the plan can be run" + (" (collisions were not checked)" if no_paths else ""))


def view(
    plan: PlanPath,
    rig: RigOption = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for both files.")] = Path(),
    no_paths: Annotated[
        bool, typer.Option("--no-paths", help="Leave out path planning and the collision checks along paths.")
    ] = False,
    show: Annotated[bool, typer.Option("--show", help="Open the page in a browser.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Draw a plan, even one that is refused: a picture (PNG) and an interactive page (HTML)."""
    from coupole.preflight.job import read_job
    from coupole.viewing.terminal import make_console
    from coupole.viewing.view import look_at_plan

    try:
        png, html = look_at_plan(read_job(plan, rig), out, make_console(quiet=as_json), paths=not no_paths)
    except InputError as error:
        fail(error, as_json=as_json)
        raise
    if show:
        typer.launch(str(html.resolve()))
    if as_json:
        print(json.dumps({"png": str(png), "html": str(html)}))


def simulate(
    plan: PlanPath,
    rig: RigOption = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Number of shots of all views together.")] = 12,
    out: Annotated[Path, typer.Option("--out", help="Folder for the pictures.")] = Path("simulated"),
    width: Annotated[
        int | None, typer.Option("--width", min=16, help="Width of the frames, if smaller than the rig's.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Render some frames of a plan, without devices, as a preview: a PNG each, and all on one sheet."""
    from rich.progress import Progress

    from coupole.preflight.job import read_job
    from coupole.viewing.simulated_frames import simulate as render
    from coupole.viewing.terminal import make_console

    try:
        job = read_job(plan, rig)
    except InputError as error:
        fail(error, as_json=as_json)
        raise
    console = make_console(quiet=as_json)
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("rendering")
        stills = render(
            job,
            out,
            frames,
            width_px=width,
            progress=lambda count, total: bars.update(bar, completed=count, total=total),
        )
    if as_json:
        print(
            json.dumps({"folder": str(out), "sheet": "sheet.png", "frames": [asdict(still) for still in stills]})
        )
        return
    for still in stills:
        over = f", [red]{still.saturated:.2%} saturated[/]" if still.saturated > 1e-3 else ""
        console.print(f"{still.file}: brightest {still.brightest:.0%}{over}")
    console.print(f"[bold]{out / 'sheet.png'}[/]")


def schema(what: Annotated[str, typer.Argument(help="plan or rig", autocompletion=schemas)]) -> None:
    """JSON schema of plans or rigs, for editors."""
    from coupole.plan.plan import Plan
    from coupole.plan.rig import Rig

    models: dict[str, type[Plan] | type[Rig]] = {"plan": Plan, "rig": Rig}
    if what not in models:
        raise typer.BadParameter(f"expected plan or rig, found {what}")
    print(json.dumps(models[what].model_json_schema(), indent=2))


@plan_app.command("new")
def plan_new(
    name: Annotated[
        str,
        typer.Argument(
            help="Name of the plan; the file is NAME.yaml.", show_default=False, autocompletion=templates
        ),
    ],
    template: Annotated[
        str | None,
        typer.Option(
            "--template",
            help="Template; by default the one called NAME, otherwise `views`.",
            autocompletion=templates,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="The rig; by default the simulated cell.", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random views of `leds`.")] = 1,
) -> None:
    """Write a plan to start from. Choosing the views of `leds` for the rig's dome takes a minute or two.

    For a calibration in a simulated cell, the command also writes NAME-rig.yaml, the rig with the board, card or
    tile on its support, and NAME-board.yaml or NAME-tile.yaml, the description of board or tile for `coupole
    calibrate`.
    """
    from coupole.plan.base_model import NAME_PATTERN
    from coupole.plan.templates import LEDS, TEMPLATES
    from coupole.viewing.terminal import make_console

    template_names = sorted([*TEMPLATES, LEDS])
    template = template or (name if name in template_names else "views")
    if template not in template_names:
        raise typer.BadParameter(f"expected one of {', '.join(template_names)}; found {template}")
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(
            f"{name!r}: expected a name of letters, digits, dots, hyphens and underscores that begins with a "
            "letter or digit: it becomes part of file names"
        )
    rig = rig or SIMULATED_CELL
    rig_path = file_of(rig, "rigs")
    if not rig_path.is_file():
        raise InputError(f"{rig}: no such file; name a rig with --rig")
    path = Path(f"{name}.yaml")
    if path.exists():
        raise InputError(f"{path}: exists already; choose another name")
    if template == LEDS:
        from coupole.calibration.leds.led_plan import led_plan
        from coupole.plan.cell import read_cell

        with make_console(quiet=False).status("reading the rig") as status:
            text = led_plan(read_cell(rig_path), name=name, rig=str(rig), seed=seed, tell=status.update)
    else:
        text = TEMPLATES[template].format(name=name, rig=_on_the_support(template, rig_path, name) or rig)
    path.write_text(text, encoding="utf-8")
    print(path)


def _on_the_support(template: str, rig: Path, name: str) -> Path | None:
    """Return a copy of a simulated cell's rig with the things that a calibration needs on its support; None if it
    needs nothing, or if the cell is real."""
    from coupole.calibration.campaign_steps import BESIDE, STEPS
    from coupole.commands.simulated_support import place_for
    from coupole.plan.cell import read_cell
    from coupole.plan.rig_devices import in_world
    from coupole.viewing.terminal import make_console

    step = next((step for step in (*STEPS, *BESIDE) if step.name == template and step.things), None)
    if step is None or not in_world(read_cell(rig).rig, dry_run=False):
        return None
    paths = place_for(template, step.things, rig, name)
    make_console(quiet=False).print(
        f"this cell is simulated: the support of {paths[0]} carries {step.stands}"
        + "".join(f"; {description} describes it" for description in paths[1:]),
        markup=False,
    )
    return paths[0]

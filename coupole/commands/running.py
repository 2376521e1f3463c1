"""Commands that open devices, real or simulated: acquire, devices, meter, live, sim."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.acquisition.signals import SignalReceived
from coupole.commands.common import (
    JsonOption,
    PlanPath,
    PlanUnlessResumed,
    RigOption,
    RunsParentOption,
    fail,
    person_named,
    plan_of,
    served_cell,
)
from coupole.commands.completion import runs
from coupole.errors import CoupoleError
from coupole.plan.shipped_files import SIMULATED_CELL, file_of

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.acquisition.processing_beside import ProcessingBeside
    from coupole.acquisition.session import SessionRequest
    from coupole.acquisition.sessions_without_run import SessionWithoutRun
    from coupole.plan.cell import Cell
    from coupole.preflight.job import Job

ReflectanceOption = Annotated[
    bool,
    typer.Option(
        "--reflectance",
        help="Take samples of each view as soon as it is complete, beside the acquisition, and end with the "
        "result that `coupole reflectance RUN` makes. When the run is resumed, the processing continues by "
        "itself.",
    ),
]
ResultOption = Annotated[
    Path | None,
    typer.Option(
        "--result",
        help="Folder of the result of --reflectance; by default the run's name followed by -reflectance.",
    ),
]


def acquire(
    plan: PlanUnlessResumed = None,
    rig: RigOption = None,
    output: RunsParentOption = None,
    resume: Annotated[Path | None, typer.Option("--resume", help="Resume this run.", autocompletion=runs)] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Rehearse on the rig's simulated twin.")] = False,
    speed: Annotated[float, typer.Option("--speed", min=0.1, max=1000, help="Pace of a dry run.")] = 20.0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a real cell moves.")] = False,
    with_mesh: Annotated[
        bool, typer.Option("--with-mesh", help="Copy the mesh into the run even if it has more than 100 MB.")
    ] = False,
    reflectance: ReflectanceOption = False,
    result: ResultOption = None,
    as_json: JsonOption = False,
    begun_by_console: Annotated[bool, typer.Option("--begun-by-console", hidden=True)] = False,
) -> None:
    """Run a plan: check it, move, trigger, prove the frames, store them.

    Ctrl-C stops safely (lights off, arm still). Resume the run with `acquire --resume RUN`, which uses the run's
    own copies of plan and rig. Or name the plan again; only its comments and the object's budget of light may have
    changed. On a terminal the key p pauses between bursts and continues, q stops. From elsewhere use `coupole
    pause`, `go-on` and `stop`. If a console owns the cell (`coupole serve`), the command enters the plan in the
    console's queue and follows the run. This needs a console at which no other plan runs or waits.
    """
    from coupole.acquisition.sessions_without_run import ACQUIRE, SessionWithoutRun

    _refuse_exclusive(resume, output, dry_run=dry_run, asks_result=reflectance or result is not None)
    summary: dict[str, Any] = {}
    try:
        with SessionWithoutRun(ACQUIRE, plan, rig, resume) as starting:  # before the imports: they take seconds
            from coupole.acquisition.session import SessionRequest
            from coupole.preflight.job import read_job
            from coupole.viewing.terminal import make_console

            console = make_console(quiet=as_json and not begun_by_console)
            console_cell = None if dry_run or begun_by_console else served_cell(plan, rig, resume)
            if console_cell is not None:
                from coupole.console.command_line.following import acquire_by_console

                starting.end()
                plan = plan or (plan_of(resume) if rig else None)
                paths = {"plan": plan, "output": output, "resume": resume, "result": result}
                request = {key: str(path.resolve()) for key, path in paths.items() if path is not None}
                flags = {"with_mesh": with_mesh, "reflectance": reflectance or result is not None}
                acquire_by_console(console_cell, console, {**request, **flags}, confirm=not yes, summary=summary)
            elif dry_run:
                from coupole.acquisition.dry_run import rehearse

                starting.end()
                rehearse(read_job(plan or plan_of(resume), rig), console, speed=speed, figures=summary)
            else:
                job = read_job(plan or plan_of(resume), rig)
                wanted_session = SessionRequest(output, resume, confirm=not yes, with_mesh=with_mesh)
                _acquire_here(job, console, wanted_session, (result, reflectance), summary, starting)
    except (CoupoleError, SignalReceived) as error:
        fail(error, as_json=as_json, figures=summary)
        raise
    if as_json:
        print(json.dumps(summary))


def _refuse_exclusive(resume: Path | None, output: Path | None, *, dry_run: bool, asks_result: bool) -> None:
    if dry_run and (resume or output or asks_result):
        raise typer.BadParameter(
            "a dry run stores nothing: --dry-run excludes --resume, --output, --reflectance and --result"
        )
    if resume and output:
        raise typer.BadParameter("a resumed run keeps its folder: --resume excludes --output")


def _acquire_here(
    job: Job,
    console: Console,
    wanted_session: SessionRequest,
    asked_result: tuple[Path | None, bool],
    summary: dict[str, Any],
    starting: SessionWithoutRun,
) -> None:
    """Acquire in this process. `asked_result` is the folder of the result, and whether one is asked for."""
    from coupole.acquisition.session import acquire_plan

    starting.know(job.document.path, job.cell.document.path)
    resume, (result, is_asked) = wanted_session.resume, asked_result
    with _beside(job, console, resume, result, summary, is_asked=is_asked) as beside:
        wanted_session = replace(wanted_session, beside=beside, when_served=starting.begin_run)
        acquire_plan(job, console, wanted_session, summary)
    starting.end()


@contextmanager
def _beside(
    job: Job,
    console: Console,
    resume: Path | None,
    result: Path | None,
    summary: dict[str, Any],
    *,
    is_asked: bool,
) -> Iterator[ProcessingBeside | None]:
    """The processing during an acquisition, if the command or the resumed run asks for it. The outcome of the
    processing is in `summary` afterwards.
    """
    from coupole.storage.run import Run

    if resume is not None:
        result = result or Run(resume).asked_result
    if not (is_asked or result):
        yield None
        return
    from coupole.acquisition.processing_beside import ProcessingBeside

    beside = ProcessingBeside(job.document.path, job.cell.document.path, result, console, resumed_run=resume)
    try:
        with beside:
            yield beside
            beside.wait()
    finally:
        if figures := beside.figures():
            summary["reflectance"] = figures


def devices(
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="The rig (YAML); by default the simulated cell.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Open each device of a rig, read its identity, run its self-test, close it."""
    from rich.table import Table

    from coupole.acquisition.opened_cell import open_cell
    from coupole.bounded import run_bounded
    from coupole.console.command_line.client import borrowed_cell
    from coupole.plan.cell import read_cell
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    cell = read_cell(rig or SIMULATED_CELL)
    document: dict[str, Any] = {}
    table = Table("device", "identity", "self-test", box=None)
    with borrowed_cell(cell, "devices"), open_cell(cell) as open_devices:
        for kind in ("ledbox", "camera", "robot"):
            identity, self_test = open_devices.identities[kind], run_bounded(getattr(open_devices, kind).self_test)
            document[kind] = {**vars(identity), "self_test": dict(self_test)}
            identity_text = f"{identity.vendor} {identity.model} {identity.serial} ({identity.firmware})"
            table.add_row(
                kind,
                identity_text + (" [dim]simulated[/]" if identity.simulated else ""),
                ", ".join(f"{key} {value}" for key, value in self_test.items()),
            )
    console.print(table)
    if as_json:
        print(json.dumps(document))


def meter(
    plan: PlanPath,
    rig: RigOption = None,
    max_saturated_share: Annotated[
        float,
        typer.Option("--saturated", min=0, max=0.5, help="Largest share of a picture's pixels that may saturate."),
    ] = 1e-3,
    snr: Annotated[float, typer.Option("--snr", min=1, help="Signal-to-noise ratio to reach.")] = 30.0,
    share: Annotated[
        float,
        typer.Option(
            "--share", min=0.01, max=1, help="Share of the object's pixels that must reach the ratio of --snr."
        ),
    ] = 0.9,
    write: Annotated[
        Path | None, typer.Option("--write", help="Write the plan with this exposure, in the plan's folder.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a real cell moves.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Advise on a plan's exposure, from a few pictures of each view under a few lights. The pictures are not
    stored.
    """
    from coupole.acquisition.looking import meter as meter_plan
    from coupole.console.command_line.client import borrowed_cell
    from coupole.preflight.exposure_advice import Request, write_plan
    from coupole.preflight.job import read_job
    from coupole.viewing.terminal import make_console, show_advice

    console = make_console(quiet=as_json)
    try:
        job = read_job(plan, rig)
        with borrowed_cell(job.cell, f"meter {plan.name}", plan):
            advice = meter_plan(job, console, Request(max_saturated_share, snr, share), confirm=not yes)
        if write is not None:
            write_plan(job.document, write, advice.exposure)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    show_advice(console, advice)
    if as_json:
        print(json.dumps({**advice.figures(), "plan": str(write) if write else None}))


def live(
    what: Annotated[
        Path,
        typer.Argument(help="A run's folder, a plan, or a rig; or a name such as sim.", show_default=False),
    ],
    led: Annotated[
        int | None, typer.Option("--led", help="Id of the LED to begin with; dark if not given.")
    ] = None,
    exposure_us: Annotated[int, typer.Option("--exposure-us", min=10, help="Exposure to begin with.")] = 8000,
    frames_per_s: Annotated[
        float, typer.Option("--fps", min=0.1, max=20, help="Largest number of pictures per second.")
    ] = 5.0,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0 for any free one.")
    ] = 0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before real LEDs are lit.")] = False,
) -> None:
    """Live view of the camera, or of a run in progress: figures here, pictures on a page for this machine.

    For a run, only its folder is read, so the run is not slowed. For a rig or a plan, the camera is opened, and
    the arm is not moved. With a plan, the light on the plan's object is entered in the object's ledger.
    """
    from coupole.acquisition.looking import watch_cell, watch_run
    from coupole.console.command_line.client import borrowed_cell
    from coupole.plan.cell import Cell
    from coupole.viewing.live import Choice
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=False)
    if what.is_dir():
        watch_run(what, console, port=port)
        return
    source = cell_or_job(what)
    choice = Choice(led, exposure_us)
    plan = None if isinstance(source, Cell) else source.document.path
    with borrowed_cell(source if isinstance(source, Cell) else source.cell, "live", plan):
        watch_cell(source, console, choice, frames_per_s=frames_per_s, port=port, confirm=not yes)


def cell_or_job(what: Path) -> Cell | Job:
    """The cell of a rig, or the job of a plan: a file, or the name of a shipped rig (first) or plan."""
    from coupole.plan.cell import read_cell
    from coupole.plan.yamlfile import read_document
    from coupole.preflight.job import read_job

    path = file_of(file_of(what, "rigs"), "plans")
    return read_job(path) if "views" in read_document(path).data else read_cell(path)


def confirm(
    rig: Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)],
    name: Annotated[
        str, typer.Option("--name", help="Name of the person who has been to the cell.", show_default=False)
    ],
    note: Annotated[str, typer.Option("--note", help="Cause of the fault.")] = "",
    as_json: JsonOption = False,
) -> None:
    """After a fault of the arm, confirm by name that the cause is found, the cell is clear, and the arm may move
    again.
    """
    from coupole.plan.cell import read_cell
    from coupole.storage.arm_faults import faults_of
    from coupole.viewing.terminal import make_console

    name = person_named(name, "the person who has been to the cell")
    console, faults = make_console(quiet=as_json), faults_of(read_cell(rig))
    standing = faults.standing()
    for fault in standing:
        console.print(f"{fault.t}  {fault.message}", markup=False)
    if standing:
        faults.confirm(name, note)
        console.print(f"confirmed by {name}: the arm may move again", markup=False)
    else:
        console.print("there is no fault of the arm; nothing to confirm")
    if as_json:
        print(json.dumps({"confirmed": [fault.model_dump() for fault in standing], "name": name}))


def sim(
    rig: Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)],
    plan: Annotated[Path | None, typer.Option("--plan", help="Put this plan's object on the support.")] = None,
    speed: Annotated[float | None, typer.Option("--speed", min=0.01, help="Pace of the world.")] = None,
) -> None:
    """Serve the simulated devices of a rig for other clients. The command prints one JSON line with their
    endpoints. On standard error it prints what the robot's controller refuses, and why. Ctrl-C ends it; the exit
    code is 4 if the devices end by themselves."""
    from coupole.plan.cell import read_cell
    from coupole.plan.registry import WORLD, load_class
    from coupole.preflight.job import read_job
    from coupole.preflight.simulated_world import frozen, world_config

    job = read_job(plan, rig) if plan else None
    cell = job.cell if job else read_cell(rig)
    driver = cell.rig.world.driver if cell.rig.world else WORLD
    config = world_config(cell, job, cell.rig.sensor, speed=speed) | {"tells_refusals": True}
    with frozen(config, cell.files) as frozen_config:
        world = load_class(driver).start(frozen_config)
    try:
        print(json.dumps(world.endpoints), flush=True)
        world.wait()
    finally:
        world.close()

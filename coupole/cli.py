"""The commands. Each reads its input, calls one thing that does the work, and says how it went."""

from __future__ import annotations

import json
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from coupole.calibrate_cli import calibrate_app
from coupole.errors import CoupoleError, InputError, Interrupted, PreflightRefused

app = typer.Typer(
    name="coupole",
    help="Acquisition controller of La Coupole: a plan in, proven frames out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
plan_app = typer.Typer(help="Plan templates.", no_args_is_help=True)
app.add_typer(plan_app, name="plan")
app.add_typer(calibrate_app, name="calibrate")

PlanPath = Annotated[Path, typer.Argument(help="The plan (YAML).", show_default=False)]
RigOption = Annotated[Path | None, typer.Option("--rig", help="Another rig than the plan names.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]
RunPath = Annotated[Path, typer.Argument(help="The run's folder.", show_default=False)]


def main() -> None:
    """Entry point: runs a command and turns Coupole's errors into messages and exit codes."""
    signal.signal(signal.SIGTERM, _as_interrupt)
    try:
        code = app(standalone_mode=False)
    except CoupoleError as error:
        _say(error)
        code = error.exit_code
    except KeyboardInterrupt:
        _say(Interrupted("stopped by the operator"))
        code = Interrupted.exit_code
    except typer.Abort:
        code = Interrupted.exit_code
    except Exception as error:  # click's usage errors, which know their own exit code
        if not hasattr(error, "exit_code") or not hasattr(error, "show"):
            raise
        error.show()
        code = error.exit_code
    sys.exit(code or 0)


def _as_interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _say(error: CoupoleError) -> None:
    kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
    print(f"{kind}{error}", file=sys.stderr)


def _fail(error: CoupoleError, *, as_json: bool, found: dict[str, Any] | None = None) -> None:
    """Put an error into the JSON document, if that was asked for; the caller raises it on."""
    if as_json:
        document = {
            **(found or {}),
            "error": str(error),
            "kind": type(error).__name__,
            "exit_code": error.exit_code,
        }
        print(json.dumps(document))


@app.command()
def check(
    plan: PlanPath,
    rig: RigOption = None,
    no_paths: Annotated[
        bool, typer.Option("--no-paths", help="Leave out path planning and swept collisions.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Say everything that can be known of a plan before a device is touched."""
    from coupole.console import make_console, show_preflight, show_views
    from coupole.job import preflight_of, read_job

    console = make_console(quiet=as_json)
    try:
        job = read_job(plan, rig)
    except InputError as error:
        _fail(error, as_json=as_json, found={"ok": False, "refusals": []})
        raise
    if not no_paths:
        job = job.without_hidden()
    job, report = preflight_of(job, job.cell.storage_folder, paths=not no_paths)
    show_preflight(console, report, name=job.plan.name, rig=job.cell.rig.name)
    show_views(console, report)
    if as_json:
        print(
            json.dumps(
                {
                    "ok": not report.refusals,
                    "refusals": report.refusals,
                    "warnings": report.warnings,
                    "views": len(report.views),
                    "shots": report.shots,
                    "frames": report.frames,
                    "bytes": report.bytes,
                    "duration_s": report.duration_s,
                    "ideal_s": report.ideal_s,
                    "dose_lux_h": report.dose_lux_h,
                    "peak_board_c": report.peak_board_c,
                    "exposures": [asdict(timing) for timing in report.timings],
                    "hidden_lights": sum(map(len, job.hidden_leds.values())),
                    "paths_checked": not no_paths,
                }
            )
        )
    if report.refusals:
        raise PreflightRefused(report.refusals)
    if not as_json:
        console.print("the plan can be run" + (" (collisions were not checked)" if no_paths else ""))


@app.command()
def view(
    plan: PlanPath,
    rig: RigOption = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for both files.")] = Path(),
    no_paths: Annotated[
        bool, typer.Option("--no-paths", help="Leave out path planning and swept collisions.")
    ] = False,
    show: Annotated[bool, typer.Option("--show", help="Open the page in a browser.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Draw a plan, refused or not: a picture (PNG) and a page to turn round (HTML)."""
    from coupole.console import make_console
    from coupole.job import read_job
    from coupole.view import look_at_plan

    try:
        png, html = look_at_plan(read_job(plan, rig), out, make_console(quiet=as_json), paths=not no_paths)
    except InputError as error:
        _fail(error, as_json=as_json)
        raise
    if show:
        typer.launch(str(html.resolve()))
    if as_json:
        print(json.dumps({"png": str(png), "html": str(html)}))


@app.command()
def simulate(
    plan: PlanPath,
    rig: RigOption = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="How many shots, over all views.")] = 12,
    out: Annotated[Path, typer.Option("--out", help="Folder for the pictures.")] = Path("simulated"),
    width: Annotated[
        int | None, typer.Option("--width", min=16, help="Of the frames, if less than the rig's.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Render some frames of a plan, without devices, for a look: a PNG each, and all on one sheet."""
    from rich.progress import Progress

    from coupole.console import make_console
    from coupole.job import read_job
    from coupole.simulate import simulate as render

    try:
        job = read_job(plan, rig)
    except InputError as error:
        _fail(error, as_json=as_json)
        raise
    console = make_console(quiet=as_json)
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("rendering")
        made = render(
            job,
            out,
            frames,
            width_px=width,
            progress=lambda done, total: bars.update(bar, completed=done, total=total),
        )
    if as_json:
        print(json.dumps({"folder": str(out), "sheet": "sheet.png", "frames": [asdict(still) for still in made]}))
        return
    for still in made:
        over = f", [red]{still.saturated:.2%} saturated[/]" if still.saturated > 1e-3 else ""
        console.print(f"{still.file}: brightest {still.brightest:.0%}{over}")
    console.print(f"[bold]{out / 'sheet.png'}[/]")


@app.command()
def acquire(
    plan: PlanPath,
    rig: RigOption = None,
    output: Annotated[Path | None, typer.Option("--output", help="Parent folder of the run.")] = None,
    resume: Annotated[Path | None, typer.Option("--resume", help="Go on with this run.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Rehearse on the rig's twin.")] = False,
    speed: Annotated[float, typer.Option("--speed", min=0.1, max=1000, help="Pace of a dry run.")] = 20.0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a real cell moves.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a plan: check it, move, fire, prove, store.

    Ctrl-C stops safely (lights off, arm still) and the run can be resumed. SIGUSR1 pauses between bursts, and
    goes on when sent again.
    """
    from coupole.console import make_console
    from coupole.job import read_job
    from coupole.session import acquire_plan, rehearse

    if dry_run and (resume or output):
        raise typer.BadParameter("a dry run keeps nothing: --resume and --output do not go with --dry-run")
    if resume and output:
        raise typer.BadParameter("a resumed run stays where it is: --output does not go with --resume")
    console = make_console(quiet=as_json)
    found: dict[str, Any] = {}
    try:
        job = read_job(plan, rig)
        if dry_run:
            rehearse(job, console, speed=speed, found=found)
        else:
            acquire_plan(job, console, parent=output, resume=resume, confirm=not yes, found=found)
    except CoupoleError as error:
        _fail(error, as_json=as_json, found=found)
        raise
    if as_json:
        print(json.dumps(found))


@app.command()
def devices(
    rig: Annotated[Path, typer.Option("--rig", help="The rig (YAML).")] = Path("configs/rigs/sim.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Open each device of a rig, let it say who it is and test itself, close it."""
    from rich.table import Table

    from coupole.cell import open_cell
    from coupole.console import make_console
    from coupole.job import read_cell

    console = make_console(quiet=as_json)
    cell = read_cell(rig)
    found: dict[str, Any] = {}
    table = Table("device", "identity", "self-test", box=None)
    with open_cell(cell) as opened:
        for kind in ("ledbox", "camera", "robot"):
            identity, tested = opened.identities[kind], getattr(opened, kind).self_test()
            found[kind] = {**vars(identity), "self_test": dict(tested)}
            who = f"{identity.vendor} {identity.model} {identity.serial} ({identity.firmware})"
            table.add_row(
                kind,
                who + (" [dim]simulated[/]" if identity.simulated else ""),
                ", ".join(f"{key} {value}" for key, value in tested.items()),
            )
    console.print(table)
    if as_json:
        print(json.dumps(found))


@app.command()
def status(run: RunPath, as_json: JsonOption = False) -> None:
    """How far a run is; works while it goes on."""
    from coupole.console import make_console, show_status
    from coupole.run import Run
    from coupole.run import status as status_of

    found = status_of(Run(run))
    show_status(make_console(quiet=as_json), found)
    if as_json:
        print(json.dumps({**vars(found), "missing": found.missing}))


@app.command()
def verify(run: RunPath, as_json: JsonOption = False) -> None:
    """Read every frame of a run back: completeness and every checksum."""
    from rich.progress import Progress

    from coupole.console import make_console
    from coupole.errors import ChecksumMismatch, UnprovenError
    from coupole.run import Run
    from coupole.run import verify as verify_run

    console = make_console(quiet=as_json)
    opened = Run(run)
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("reading back")
        found = verify_run(opened, lambda done, total: bars.update(bar, completed=done, total=total))
    for problem in found.bad:
        console.print(f"[red]bad:[/] {problem}")
    if found.missing:
        console.print(f"[red]missing:[/] {len(found.missing)} frames, the first {found.missing[0]}")
    if as_json:
        print(json.dumps({"ok": found.ok, "frames": found.frames, "bad": found.bad, "missing": found.missing}))
    if found.bad:
        raise ChecksumMismatch(f"{len(found.bad)} of {found.frames} frames are not as they were written")
    if found.missing:
        raise UnprovenError(f"{len(found.missing)} frames of the plan are missing; resume the run")
    console.print(f"ok: {found.frames} frames, each of them once, all checksums right")


@app.command()
def archive(
    run: RunPath,
    codec: Annotated[str, typer.Option("--codec", help="lz4 (fast) or zstd (a little smaller).")] = "lz4",
    keep: Annotated[bool, typer.Option("--keep", help="Keep the files as they were, in RUN/unarchived.")] = False,
    partial: Annotated[
        bool, typer.Option("--partial", help="Of a run that is not complete, archive the complete views.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Compress a run's frames, bit for bit; a view is read back and compared before it replaces the old file."""
    from rich.progress import Progress

    from coupole.archive import archive_run
    from coupole.bitshuffle import codec_of
    from coupole.console import bytes_text, make_console
    from coupole.run import Run

    console = make_console(quiet=as_json)
    try:
        with Progress(console=console, disable=not console.is_terminal) as bars:
            bar = bars.add_task("archive")
            found = archive_run(
                Run(run),
                codec_of(codec),
                keep=keep,
                partial=partial,
                progress=lambda what, done, total: bars.update(bar, description=what, completed=done, total=total),
                on_view=lambda view: console.print(
                    f"{view.view}: {view.frames} frames {view.ratio:.2f} times smaller, "
                    f"{bytes_text(view.freed_bytes)} freed"
                ),
            )
    except CoupoleError as error:
        _fail(error, as_json=as_json)
        raise
    total = found.figures()
    if found.views:
        console.print(f"ratio {total['ratio']:.2f} at {total['mb_s']:.0f} MB/s, reading back included")
    for views, how in ((found.already, "archived already"), (found.incomplete, "not complete, left as it is")):
        for view in views:
            console.print(f"{view}: {how}")
    if as_json:
        print(json.dumps({"run": str(run.resolve()), "codec": codec, **total}))


@app.command()
def export(
    run: RunPath,
    to: Annotated[str, typer.Option("--to", help="dng or tiff.", show_default=False)],
    views: Annotated[
        list[str] | None, typer.Option("--views", help="Names, with * and ?; again for more.")
    ] = None,
    shots: Annotated[
        list[str] | None, typer.Option("--shots", help="Labels, as `led04*/e0`; again for more.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder; RUN/export if not given.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write over files that stand there.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write proven frames as files of another format, one for each, named after its shot."""
    from rich.progress import Progress

    from coupole.console import bytes_text, make_console
    from coupole.export import export_run
    from coupole.run import Run

    console = make_console(quiet=as_json)
    folder = out or run / "export"
    try:
        with Progress(console=console, disable=not console.is_terminal) as bars:
            bar = bars.add_task("export")
            found = export_run(
                Run(run),
                to,
                folder,
                views=views or [],
                shots=shots or [],
                overwrite=overwrite,
                progress=lambda done, total: bars.update(bar, completed=done, total=total),
            )
    except CoupoleError as error:
        _fail(error, as_json=as_json)
        raise
    console.print(f"{found.files} files, {bytes_text(found.bytes)}, in {folder}")
    if as_json:
        print(json.dumps({"out": str(folder.resolve()), "files": found.files, "bytes": found.bytes}))


@app.command()
def scan(
    mesh: Annotated[Path, typer.Argument(help="The scanner's mesh: PLY, STL or OBJ.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="A new folder for what was read.", show_default=False)],
    targets: Annotated[Path | None, typer.Option("--targets", help="Table of the scanner's targets.")] = None,
    unit: Annotated[str, typer.Option("--unit", help="The mesh's unit: mm, cm, m, um or in.")] = "mm",
    targets_unit: Annotated[
        str | None, typer.Option("--targets-unit", help="The table's, if it is another.")
    ] = None,
    accept_defects: Annotated[
        bool, typer.Option("--accept-defects", help="Take a mesh that is no clean surface.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Take a scanned mesh and its targets in: check them, bring them to mm, draw them."""
    from coupole.console import make_console
    from coupole.scan import UNITS, import_scan

    for option, given in (("--unit", unit), ("--targets-unit", targets_unit)):
        if given is not None and given not in UNITS:
            raise InputError(f"{option} {given}: expected one of {', '.join(UNITS)}")
    console = make_console(quiet=as_json)
    with console.status("reading the mesh") as status:
        found = import_scan(
            mesh,
            targets,
            out,
            unit=unit,
            targets_unit=targets_unit,
            accept_defects=accept_defects,
            progress=status.update,
        )
    if as_json:
        print(json.dumps(found))
        return
    size_mm = " x ".join(f"{value:.1f}" for value in found["size_mm"])
    console.print(f"{found['triangles']:,} triangles, {found['vertices']:,} vertices, {size_mm} mm")
    console.print(f"median edge {found['median_edge_mm']} mm, {found['open_edges']:,} open edges")
    if targets:
        console.print(f"{found['targets']} targets")
    console.print(f"[bold]{out}[/]: mesh.ply, scan.json, scan.png" + (", targets.csv" if targets else ""))


@app.command()
def meter(
    plan: PlanPath,
    rig: RigOption = None,
    saturated: Annotated[
        float, typer.Option("--saturated", min=0, max=0.5, help="Share of a picture's pixels that may saturate.")
    ] = 1e-3,
    snr: Annotated[float, typer.Option("--snr", min=1, help="Signal-to-noise ratio to reach.")] = 30.0,
    share: Annotated[
        float, typer.Option("--share", min=0.01, max=1, help="Share of the object's pixels that must reach it.")
    ] = 0.9,
    write: Annotated[
        Path | None, typer.Option("--write", help="Write the plan with this exposure, in the plan's folder.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a real cell moves.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Advise on a plan's exposure: a few pictures of each view, under a few lights, none of them kept."""
    from coupole.console import make_console, show_advice
    from coupole.job import read_job
    from coupole.metering import Wish, write_plan
    from coupole.session import meter as meter_plan

    console = make_console(quiet=as_json)
    try:
        advice = meter_plan(read_job(plan, rig), console, Wish(saturated, snr, share), confirm=not yes)
        if write is not None:
            write_plan(plan, write, advice.exposure)
    except CoupoleError as error:
        _fail(error, as_json=as_json)
        raise
    show_advice(console, advice)
    if as_json:
        print(
            json.dumps(
                {
                    "exposure": advice.exposure.model_dump(mode="json"),
                    "remarks": advice.remarks,
                    "noise": asdict(advice.noise),
                    "views": {seen.view: asdict(seen) for seen in advice.views},
                    "plan": str(write) if write else None,
                }
            )
        )


@app.command()
def live(
    what: Annotated[Path, typer.Argument(help="A run's folder, a plan, or a rig.", show_default=False)],
    led: Annotated[int | None, typer.Option("--led", help="The LED to begin with; none is dark.")] = None,
    exposure_us: Annotated[int, typer.Option("--exposure-us", min=10, help="Exposure to begin with.")] = 8000,
    frames_per_s: Annotated[
        float, typer.Option("--fps", min=0.1, max=20, help="Pictures a second, at most.")
    ] = 5.0,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the page; 0: any.")] = 0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before real light is given.")] = False,
) -> None:
    """Look through the camera, or at a run that goes on: figures here, pictures on a page for this machine.

    Of a run the folder alone is read, so it is never slowed. Of a rig or a plan (then its object's light is
    entered in the ledger) the camera is taken; the arm is held where it stands.
    """
    from coupole.console import make_console
    from coupole.job import read_cell, read_job
    from coupole.live import Choice
    from coupole.session import watch_cell, watch_run
    from coupole.yamlfile import read

    console = make_console(quiet=False)
    if what.is_dir():
        watch_run(what, console, port=port)
        return
    source = read_job(what) if "views" in read(what).data else read_cell(what)
    choice = Choice(led, exposure_us)
    watch_cell(source, console, choice, frames_per_s=frames_per_s, port=port, confirm=not yes)


@app.command()
def sim(
    rig: Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)],
    plan: Annotated[Path | None, typer.Option("--plan", help="Put this plan's object on the support.")] = None,
    speed: Annotated[float | None, typer.Option("--speed", min=0.01, help="Pace of the world.")] = None,
) -> None:
    """Serve a rig's stand-ins for other clients; prints one JSON line with their endpoints, until Ctrl-C."""
    from coupole.cell import world_config
    from coupole.job import read_cell, read_job
    from coupole.rig import load_class

    job = read_job(plan, rig) if plan else None
    cell = job.cell if job else read_cell(rig)
    driver = cell.rig.world.driver if cell.rig.world else "sim.client:World"
    world = load_class(driver).start(world_config(cell, job, cell.rig.sensor, speed=speed))
    try:
        print(json.dumps(world.endpoints), flush=True)
        world.wait()
    finally:
        world.close()


@app.command()
def schema(what: Annotated[str, typer.Argument(help="plan or rig")]) -> None:
    """JSON schema of plans or rigs, for editors."""
    from coupole.plan import Plan
    from coupole.rig import Rig

    models: dict[str, type[Plan] | type[Rig]] = {"plan": Plan, "rig": Rig}
    if what not in models:
        raise typer.BadParameter(f"expected plan or rig, found {what}")
    print(json.dumps(models[what].model_json_schema(), indent=2))


@plan_app.command("new")
def plan_new(
    name: Annotated[str, typer.Argument(help="Name of the plan; the file is NAME.yaml.", show_default=False)],
    template: Annotated[
        str | None, typer.Option("--template", help="Which template; the one called NAME, else `views`.")
    ] = None,
    rig: Annotated[str, typer.Option("--rig", help="Path of the rig, relative to the plan.")] = "../rigs/sim.yaml",
) -> None:
    """Write a plan to start from."""
    from coupole.templates import TEMPLATES

    template = template or (name if name in TEMPLATES else "views")
    if template not in TEMPLATES:
        raise typer.BadParameter(f"expected one of {', '.join(sorted(TEMPLATES))}; found {template}")
    path = Path(f"{name}.yaml")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(TEMPLATES[template].format(name=name, rig=rig))
    except FileExistsError as error:
        raise InputError(f"{path}: stands here already; choose another name") from error
    print(path)


if __name__ == "__main__":
    main()

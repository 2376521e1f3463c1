"""Commands on stored data: status, report, verify, archive, scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, RunPath, fail
from coupole.commands.run_controls import RunningRun, follow, running_run
from coupole.errors import ChecksumMismatch, CoupoleError, InputError, UnprovenError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.storage.run import Run
    from coupole.storage.verification import Verification


def status(
    run: RunningRun = None,
    following: Annotated[bool, typer.Option("--follow", help="Show the progress until the run ends.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the progress of a run, also while it is running, and the command line that continues it.

    Without RUN, show the run that is being acquired.
    """
    from coupole.storage.run import Run
    from coupole.storage.run_status import status as status_of
    from coupole.viewing.terminal import make_console, show_status

    console = make_console(quiet=as_json)
    if run is None or (following and Run(run).in_use):
        run = follow(run, console) if following else Path(running_run(run)["run"])
    progress = status_of(Run(run))
    show_status(console, progress)
    if as_json:
        print(json.dumps(progress.figures()))


def report(
    run: RunPath,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="File for the report; by default RUN/report.html.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a run's report from its folder: at any time, also while it is running, and after a crash."""
    from coupole.acquisition.conclusion import renew_report
    from coupole.storage.run import Run
    from coupole.viewing import report as page
    from coupole.viewing.terminal import make_console

    path = page.write(Run(run), out) if out else renew_report(Run(run))
    make_console(quiet=as_json).print(f"report {path}")
    if as_json:
        print(json.dumps({"report": str(path.resolve())}))


def verify(
    run: RunPath,
    with_manifest: Annotated[
        bool, typer.Option("--manifest", help="Add to manifest.sha256 the files that it does not list yet.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Read a run back: every frame, and every file that the manifest lists. Check that the run is complete, that
    all checksums are right, and that light, exposure and pose of each frame agree with the run's plan. For a
    report of `coupole identify`: tell whether anything was changed after it was written.
    """
    from coupole.heritage.result_pages.identification_record import is_record

    if is_record(run):
        _verify_report(run, as_json=as_json)
        return
    from rich.progress import Progress

    from coupole.storage import manifest
    from coupole.storage.run import Run
    from coupole.storage.verification import verify as verify_run
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    folder = Run(run)
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("reading back")

        def show(count: int, total: int) -> None:
            bars.update(bar, completed=count, total=total)

        check = verify_run(folder, show)
        if with_manifest and not check.bad:
            with folder.hold_lock():
                manifest.enter(folder.folder, manifest.unlisted_files(folder.folder), show)
            check.unlisted = []
    _show_verified(console, folder, check)
    if as_json:
        document = {"ok": check.ok, "proof": folder.proof, "frames": check.frames, "listed": check.listed_count}
        print(
            json.dumps(
                {
                    **document,
                    "discarded": sum(check.discarded_counts.values()),
                    **{key: getattr(check, key) for key in ("bad", "missing", "unlisted", "not_compared")},
                }
            )
        )
    if check.bad:
        subject = "1 thing is" if len(check.bad) == 1 else f"{len(check.bad)} things are"
        raise ChecksumMismatch(
            f"{subject} not right (above); {check.frames} frames and {check.listed_count} files of the manifest "
            "were read back"
        )
    if check.missing:
        goes_on = f"go on with `{folder.go_on_command}`"
        if folder.in_use:
            at_work = f"process {folder.holder}" if folder.holder else "another process"
            goes_on = f"{at_work} is at work on this run: verify it again when this process has ended"
        raise UnprovenError(f"{len(check.missing)} frames of the plan are missing; {goes_on}")


def _verify_report(folder: Path, *, as_json: bool) -> None:
    """Compare a report of an identification with its checksums. Raises ChecksumMismatch."""
    from coupole.heritage.result_pages.identification_record import check_record
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    check = check_record(folder)
    for problem in check.problems:
        console.print("[red]changed:[/]", problem)
    signature = check.signature
    words = (
        "not signed"
        if signature is None
        else f"signed by {signature.name}, {signature.role}, {signature.time_utc}"
    )
    if as_json:
        document = {
            "ok": not check.problems,
            "signature": None if signature is None else signature.__dict__,
            "files": check.files,
            "bad": list(check.problems),
        }
        print(json.dumps(document))
    if check.problems:
        raise ChecksumMismatch(f"{folder}: the report ({words}) is not as it was written: {len(check.problems)} "
                               "differences (above)")  # fmt: skip
    console.print(
        f"ok: record and {check.files} files are as they were written; {words}. The checksums show whether "
        "anything was changed, not who signed",
        markup=False,
    )


def _show_verified(console: Console, run: Run, verification: Verification) -> None:
    for problem in verification.bad:
        console.print("[red]bad:[/]", problem)
    if verification.missing:
        console.print(
            f"[yellow]missing:[/] {len(verification.missing)} frames, the first {verification.missing[0]}"
        )
    if verification.ok:
        console.print(
            f"ok: {verification.frames} frames, each exactly once, all checksums right; proof: {run.proof}"
        )
    if verification.discarded_counts:
        _show_discarded(console, verification)
    if verification.not_compared:
        console.print(f"[yellow]not compared with the plan:[/] {verification.not_compared}")
    if verification.listed_count and not verification.bad:
        console.print(f"{verification.listed_count} files have the checksums of manifest.sha256")
    if verification.unlisted:
        console.print(
            f"not listed in manifest.sha256: {', '.join(verification.unlisted[:5])}"
            f"{' ...' if verification.unlisted[5:] else ''} (`--manifest` adds these files)",
            markup=False,
        )


def _show_discarded(console: Console, verification: Verification) -> None:
    counts = ", ".join(f"{count} of {view}" for view, count in verification.discarded_counts.items())
    total = sum(verification.discarded_counts.values())
    console.print(
        f"{total} more frames were discarded, as the plan says (discard: after_fit): {counts}. Nobody can look at "
        "them again. The journal has the shots and checksums of these frames. The samples that were taken "
        "from the frames replace them:",
        markup=False,
    )
    samples = (
        ": its samples are unchanged since they were read back (before frames were discarded) or replaced later"
        if not verification.bad
        else " (the faults are listed above)"
    )
    for result in verification.results:
        console.print(f"  {result}{samples}", markup=False, soft_wrap=True)


def archive(
    run: RunPath,
    codec: Annotated[str, typer.Option("--codec", help="lz4 (fast) or zstd (a little smaller).")] = "lz4",
    keep: Annotated[bool, typer.Option("--keep", help="Keep the original files, in RUN/unarchived.")] = False,
    partial: Annotated[
        bool, typer.Option("--partial", help="Archive the complete views of a run that is not complete.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Compress a run's frames, bit for bit; a view is read back and compared before it replaces the old file."""
    from rich.progress import Progress

    from coupole.storage.archive import archive_run
    from coupole.storage.bitshuffle import codec_of
    from coupole.storage.run import Run
    from coupole.viewing.terminal import bytes_text, make_console

    console = make_console(quiet=as_json)
    try:
        with Progress(console=console, disable=not console.is_terminal) as bars:
            bar = bars.add_task("archive")
            summary = archive_run(
                Run(run),
                codec_of(codec),
                keep=keep,
                partial=partial,
                progress=lambda step_name, count, total: bars.update(
                    bar, description=step_name, completed=count, total=total
                ),
                on_view=lambda view: console.print(
                    f"{view.view}: {view.frames} frames {view.ratio:.2f} times smaller, "
                    f"{bytes_text(view.freed_bytes)} freed"
                ),
            )
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    total = summary.figures()
    if summary.views:
        console.print(f"ratio {total['ratio']:.2f} at {total['mb_s']:.0f} MB/s, reading back included")
    for views, how in ((summary.already, "archived already"), (summary.incomplete, "not complete, left as it is")):
        for view in views:
            console.print(f"{view}: {how}")
    if as_json:
        print(json.dumps({"run": str(run.resolve()), "codec": codec, **total}))


def scan(
    mesh: Annotated[Path, typer.Argument(help="The scanner's mesh: PLY, STL or OBJ.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="A new folder for the scan.", show_default=False)],
    targets: Annotated[Path | None, typer.Option("--targets", help="Table of the scanner's targets.")] = None,
    unit: Annotated[str, typer.Option("--unit", help="The mesh's unit: mm, cm, m, um or in.")] = "mm",
    targets_unit: Annotated[
        str | None, typer.Option("--targets-unit", help="Unit of the table, if it differs from the mesh's.")
    ] = None,
    accept_defects: Annotated[
        bool, typer.Option("--accept-defects", help="Accept a mesh with defects of its surface.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Import a scanned mesh and its targets: check them, convert them to mm, draw them."""
    from coupole.scan.scan import UNITS
    from coupole.viewing.scan_sheet import import_scan
    from coupole.viewing.terminal import make_console

    for option, unit_name in (("--unit", unit), ("--targets-unit", targets_unit)):
        if unit_name is not None and unit_name not in UNITS:
            raise InputError(f"{option} {unit_name}: expected one of {', '.join(UNITS)}")
    console = make_console(quiet=as_json)
    with console.status("reading the mesh") as status:
        facts = import_scan(
            mesh,
            targets,
            out,
            unit=unit,
            targets_unit=targets_unit,
            accept_defects=accept_defects,
            progress=status.update,
        )
    if as_json:
        print(json.dumps(facts))
        return
    size_mm = " x ".join(f"{value:.1f}" for value in facts["size_mm"])
    console.print(f"{facts['triangles']:,} triangles, {facts['vertices']:,} vertices, {size_mm} mm")
    console.print(f"median edge {facts['median_edge_mm']} mm, {facts['open_edges']:,} open edges")
    if targets:
        console.print(f"{facts['targets']} targets")
    console.print(f"[bold]{out}[/]: mesh.ply, scan.json, scan.png" + (", targets.csv" if targets else ""))

"""Commands on stored data: status, verify, archive, export, scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import JsonOption, RunPath, fail
from coupole.errors import CoupoleError, InputError
from coupole.exchange import FORMATS


def status(run: RunPath, as_json: JsonOption = False) -> None:
    """Progress of a run, also while it is running."""
    from coupole.storage.run import Run
    from coupole.storage.run import status as status_of
    from coupole.viewing.terminal import make_console, show_status

    found = status_of(Run(run))
    show_status(make_console(quiet=as_json), found)
    if as_json:
        print(json.dumps({**vars(found), "missing": found.missing}))


def verify(run: RunPath, as_json: JsonOption = False) -> None:
    """Read every frame of a run back: completeness and every checksum."""
    from rich.progress import Progress

    from coupole.errors import ChecksumMismatch, UnprovenError
    from coupole.storage.run import Run
    from coupole.storage.run import verify as verify_run
    from coupole.viewing.terminal import make_console

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
        document = {"ok": found.ok, "proof": opened.proof, "frames": found.frames}
        print(json.dumps({**document, "bad": found.bad, "missing": found.missing}))
    if found.bad:
        raise ChecksumMismatch(f"{len(found.bad)} of {found.frames} frames differ from what was written")
    if found.missing:
        raise UnprovenError(f"{len(found.missing)} frames of the plan are missing; resume the run")
    console.print(f"ok: {found.frames} frames, each exactly once, all checksums right; proof: {opened.proof}")


def archive(
    run: RunPath,
    codec: Annotated[str, typer.Option("--codec", help="lz4 (fast) or zstd (a little smaller).")] = "lz4",
    keep: Annotated[bool, typer.Option("--keep", help="Keep the original files, in RUN/unarchived.")] = False,
    partial: Annotated[
        bool, typer.Option("--partial", help="Of a run that is not complete, archive the complete views.")
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
        fail(error, as_json=as_json)
        raise
    total = found.figures()
    if found.views:
        console.print(f"ratio {total['ratio']:.2f} at {total['mb_s']:.0f} MB/s, reading back included")
    for views, how in ((found.already, "archived already"), (found.incomplete, "not complete, left as it is")):
        for view in views:
            console.print(f"{view}: {how}")
    if as_json:
        print(json.dumps({"run": str(run.resolve()), "codec": codec, **total}))


def export(
    run: RunPath,
    to: Annotated[str, typer.Option("--to", help=f"{' or '.join(FORMATS)}.", show_default=False)],
    views: Annotated[
        list[str] | None, typer.Option("--views", help="Names, with * and ?; again for more.")
    ] = None,
    shots: Annotated[
        list[str] | None, typer.Option("--shots", help="Labels, as `led04*/e0`; again for more.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder; RUN/export if not given.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite existing files.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write proven frames as files of another format, one for each, named after its shot."""
    from rich.progress import Progress

    from coupole.exchange.export import export_run
    from coupole.storage.run import Run
    from coupole.viewing.terminal import bytes_text, make_console

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
        fail(error, as_json=as_json)
        raise
    console.print(f"{found.files} files, {bytes_text(found.bytes)}, in {folder}")
    if as_json:
        print(json.dumps({"out": str(folder.resolve()), "files": found.files, "bytes": found.bytes}))


def scan(
    mesh: Annotated[Path, typer.Argument(help="The scanner's mesh: PLY, STL or OBJ.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="A new folder for the scan.", show_default=False)],
    targets: Annotated[Path | None, typer.Option("--targets", help="Table of the scanner's targets.")] = None,
    unit: Annotated[str, typer.Option("--unit", help="The mesh's unit: mm, cm, m, um or in.")] = "mm",
    targets_unit: Annotated[
        str | None, typer.Option("--targets-unit", help="The table's, if it is another.")
    ] = None,
    accept_defects: Annotated[
        bool, typer.Option("--accept-defects", help="Accept a mesh that is not a clean surface.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Import a scanned mesh and its targets: check them, convert them to mm, draw them."""
    from coupole.scan.scan import UNITS
    from coupole.viewing.scan_sheet import import_scan
    from coupole.viewing.terminal import make_console

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

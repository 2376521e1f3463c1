"""The command `coupole compare`: what changed between two states of an object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError


def compare(
    before: Annotated[
        Path,
        typer.Argument(
            help="A mesh or cloud (PLY, STL, OBJ), or the folder of a fitted `coupole reflectance`.",
            show_default=False,
        ),
    ],
    after: Annotated[Path, typer.Argument(help="Another state of the same object.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", help="A new folder for report and maps.", show_default=False)
    ] = None,
    unit: Annotated[str, typer.Option("--unit", help="Unit of both: mm, cm, m, um or in.")] = "mm",
    noise_mm: Annotated[
        float | None,
        typer.Option(
            "--noise-mm",
            help="Standard deviation of a point of either state; by default estimated from the scatter.",
            show_default=False,
        ),
    ] = None,
    is_aligned: Annotated[
        bool, typer.Option("--aligned", help="Both are in one frame already: do not align them.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Compare two states: align them by what did not change, then mark significant changes of shape and colour."""
    from coupole.heritage.comparison.state_comparison import about
    from coupole.scan.scan import new_scan_folder
    from coupole.scripting import analyses
    from coupole.viewing import comparison_page
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        if out is not None and out.exists():
            raise InputError(f"--out {out}: exists already; name a new folder")
        with step_bars(console) as say:
            changes = analyses.compare(
                before, after, unit=unit, noise_mm=noise_mm, is_aligned=is_aligned, progress=say
            )
            facts = about(changes)
            if out is not None:
                say("drawing", 0, 1)
                with new_scan_folder(out) as folder:
                    (folder / "comparison.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
                    comparison_page.write(changes, folder)
                say("drawing", 1, 1)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    for remark in comparison_page.remarks(changes):
        console.print(remark)
    if out is not None:
        console.print(f"[bold]{out}[/]: report.html, maps.ply, comparison.json")
    if as_json:
        print(json.dumps(facts))

"""`coupole restore MESH`: renders hypotheses of an object's earlier look; its step `pick` makes a page to mark
parts by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JobOrStep, JsonOption, fail
from coupole.errors import CoupoleError, InputError, StorageError, reason

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.heritage.restoration.restoration_file import Choice
    from coupole.heritage.restoration.restoring import Restoration, Say

MeshArgument = Annotated[Path, typer.Argument(help="The mesh: PLY, OBJ, STL, GLB, glTF, OFF.", show_default=False)]
UnitOption = Annotated[str, typer.Option("--unit", help="Unit of the mesh: mm, cm, m, um or in.")]
HypothesisOption = Annotated[
    list[str] | None,
    typer.Option("--hypothesis", help="Render only this hypothesis; repeat for more.", show_default=False),
]
LightsOption = Annotated[
    str | None,
    typer.Option(
        "--lights",
        help="Render under this set of the file's `other_lights`, in place of its `lights`.",
        show_default=False,
    ),
]
_JOB = "from"


class RenderOrPick(JobOrStep):
    """The first word `pick` calls that step; all other words belong to the restoration."""

    job = _JOB


restore_app = typer.Typer(
    cls=RenderOrPick,
    help="Virtual restoration: what a statue or a part of a building may have looked like, by stated "
    "hypotheses.\n\n"
    "`coupole restore MESH --parts PARTS --materials FILE.yaml --out DIR` renders; `coupole restore from --help` "
    "lists its options. `coupole restore pick MESH --out FILE.html` writes a page on which parts are painted.",
    no_args_is_help=True,
)


@restore_app.command(_JOB)
def restore(
    mesh: MeshArgument,
    parts: Annotated[
        Path,
        typer.Option("--parts", help="Triangles of each part: YAML, or JSON of `pick`.", show_default=False),
    ],
    materials: Annotated[
        Path,
        typer.Option("--materials", help="Hypotheses with sources and materials (YAML).", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for pictures and report.", show_default=False)],
    hypothesis: HypothesisOption = None,
    lights: LightsOption = None,
    unit: UnitOption = "mm",
    samples: Annotated[
        int | None,
        typer.Option("--samples", min=1, help="Number of light paths through each pixel.", show_default=False),
    ] = None,
    width: Annotated[
        int | None, typer.Option("--width", min=4, help="Smaller width of the pictures.", show_default=False)
    ] = None,
    step: Annotated[
        int | None,
        typer.Option("--step", help="Step between spectral bands, nm: 5, 10, 20 or 40.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Render hypotheses of how an object looked: labelled pictures, side by side, their differences, and a report.

    Pictures that are there already with the same settings are not rendered again.
    """
    from coupole.heritage.restoration.restoration_file import Choice
    from coupole.heritage.restoration.restoring import render_all
    from coupole.heritage.restoration.scene_of_hypothesis import write_scenes
    from coupole.heritage.restoration.shown_hypotheses import refuse_other_lights, show_all
    from coupole.heritage.result_pages import restoration_page
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        if out.exists() and not out.is_dir():
            raise InputError(f"--out {out}: expected a folder, found a file; name another one")
        with step_bars(console) as say:
            choice = Choice(tuple(hypothesis or ()), lights, samples, width, step)
            restoration = checked_restoration(mesh, parts, materials, choice, unit, say)
            refuse_other_lights(out, lights)
            pictures = render_all(restoration, out, say)
            result = show_all(restoration, pictures, out, say)
            write_scenes(restoration, result["white_cd_m2"], out)
            _write_page(restoration_page, result, out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps({"folder": str(out), **result}))
    else:
        _say(result, out, console)


def checked_restoration(
    mesh: Path,
    parts: Path,
    materials: Path,
    choice: Choice,
    unit: str,
    say: Say,
) -> Restoration:
    """Read and check all that the restoration needs. Raises InputError."""
    from coupole.heritage.restoration import part_labels, parts_file, restoration_file
    from coupole.heritage.restoration.painted_mesh import read_painted
    from coupole.heritage.restoration.restoring import Restoration

    document, materials_file = restoration_file.read_restoration(materials)
    materials_file = restoration_file.chosen_file(document, materials_file, choice)
    hypotheses = restoration_file.chosen_hypotheses(document, materials_file, choice.hypotheses)
    rules_document, rules = parts_file.read_parts(parts)
    say("reading the mesh", 0, 2)
    painted_mesh = read_painted(mesh, unit)
    say("reading the mesh", 1, 2)
    labels = part_labels.parts_of(painted_mesh, rules_document, rules)
    say("reading the mesh", 2, 2)
    restoration_file.expect_parts(document, materials_file, labels.names, parts)
    return Restoration(painted_mesh, labels, document, materials_file, hypotheses, choice.lights)


@restore_app.command()
def pick(
    mesh: MeshArgument,
    out: Annotated[Path, typer.Option("--out", help="Write this page (HTML).")] = Path("pick.html"),
    materials: Annotated[
        Path | None,
        typer.Option(
            "--materials", help="Hypotheses (YAML) whose parts the page offers by name.", show_default=False
        ),
    ] = None,
    unit: UnitOption = "mm",
    as_json: JsonOption = False,
) -> None:
    """Write a page, one file that needs no network, on which you paint parts. It saves the file that `--parts`
    reads.
    """
    from coupole.exchange.pick.pick_page import write_pick_page
    from coupole.heritage.restoration.painted_mesh import read_painted
    from coupole.heritage.restoration.restoration_file import names_of_parts, read_restoration
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        names = [] if materials is None else names_of_parts(read_restoration(materials)[1])
        with console.status("reading the mesh"):
            painted_mesh = read_painted(mesh, unit)
            triangles = write_pick_page(painted_mesh.vertices_mm, painted_mesh.triangles, mesh.name, out, names)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    document = {
        "page": str(out),
        "triangles_of_the_mesh": len(painted_mesh.triangles),
        "triangles_of_the_page": triangles,
        "parts": names,
    }
    if as_json:
        print(json.dumps(document))
    else:
        fewer = (
            ""
            if triangles == len(painted_mesh.triangles)
            else f", simplified from {len(painted_mesh.triangles):,}"
        )
        console.print(f"{out}: {triangles:,} triangles{fewer}; open it in a browser", markup=False)


# -- helpers --------------------------------------------------------------------------------------------------


def _write_page(page: Any, result: dict[str, Any], out: Path) -> None:
    try:
        page.write(result, out)
    except OSError as error:
        raise StorageError(f"{out}: {reason(error)}. Choose another folder, or free space.") from error


def _say(result: dict[str, Any], out: Path, console: Console) -> None:
    from coupole.heritage.result_pages.restoration_page import scene_uses

    for remark in result["remarks"]:
        console.print(remark, markup=False)
    count = result["taken_as_they_were"]
    note = f"; {count} were there already" if count else ""
    console.print(
        f"{out}: {result['made_anew']} pictures rendered{note}; "
        f"white {result['white_cd_m2']:.4g} cd/m2, simulated",
        markup=False,
    )
    console.print(f"{out / 'report.html'}: {len(result['hypotheses'])} hypotheses", markup=False)
    for hypothesis in result["hypotheses"]:
        console.print(f"{out / hypothesis['name'] / 'scene.yaml'}: for {scene_uses(result)}", markup=False)

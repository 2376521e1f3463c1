"""The command `coupole register`: finds the poses of scans, and merges the scans."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from coupole.scan.registration.merging import Merged
    from coupole.scan.registration.registering import Registration, Say


def _option(name: str, help_text: str) -> typer.models.OptionInfo:
    return typer.Option(name, help=help_text, show_default=False)  # type: ignore[no-any-return]


ScansArgument = Annotated[
    list[Path],
    typer.Argument(
        help="Two or more, in any order: PLY, STL, OBJ, PTX, PTS, E57, or text with x y z; a PTX, PTS or E57 "
        "may hold several.",
        show_default=False,
    ),
]
SeenFromOption = Annotated[
    str | None,
    _option(
        "--seen-from",
        "Place of the scanner in each scan's frame: origin, far away along +x, -x, +y, -y, +z or -z, or none; by "
        "default found from the scans.",
    ),
]
TrustOption = Annotated[
    bool,
    typer.Option(
        "--trust-poses",
        help="Start from the poses that PTX and E57 state; they are still tested and adjusted.",
    ),
]


def register(
    scans: ScansArgument,
    out: Annotated[Path, _option("--out", "A new folder for poses, mesh and report.")],
    unit: Annotated[
        str | None,
        _option("--unit", "Unit of scans and tables: mm (default), cm, m, um or in. E57 is always in m."),
    ] = None,
    targets: Annotated[
        Path | None, _option("--targets", "Table of targets in the scans: scan, name, x, y, z, u_mm.")
    ] = None,
    control: Annotated[
        Path | None, _option("--control", "Table of targets whose places are known: name, x, y, z, u_mm.")
    ] = None,
    seen_from: SeenFromOption = None,
    trust_poses: TrustOption = False,
    mesh_mm: Annotated[
        float | None,
        _option("--mesh-mm", "Size of the merged mesh's cells; by default 1.5 times the spacing of the points."),
    ] = None,
    no_mesh: Annotated[bool, typer.Option("--no-mesh", help="Write poses only.")] = False,
    levels: Annotated[
        str, typer.Option("--levels", help="Point spacings of the thinned clouds, mm.")
    ] = "5,10,50,250",
    as_json: JsonOption = False,
) -> None:
    """Find the poses of scans from their overlaps, test them by loops, and merge the scans."""
    from coupole.scan.registration.summary import about, frame_of_mesh, remarks
    from coupole.scan.scan import new_scan_folder
    from coupole.scripting import analyses
    from coupole.viewing import registration_page
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        unit = _unit(unit, scans)
        _refuse_cells(mesh_mm)
        levels_mm = _levels(levels)
        with new_scan_folder(out) as folder, step_bars(console) as say:
            registration = analyses.register(
                scans, unit=unit, targets=targets, control=control, seen_from=seen_from,
                trust_poses=trust_poses, progress=say,
            )  # fmt: skip
            mesh = None if no_mesh else _merge_scans(registration, unit, mesh_mm, levels_mm, folder, say)
            document = about(registration, mesh)
            (folder / "registration.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
            say("drawing", 0, 1)
            registration_page.write(registration, mesh, folder, name=out.resolve().name)
            say("drawing", 1, 1)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    for remark in remarks(registration):
        console.print(remark)
    of_mesh = "" if mesh is None else f", mesh.ply (frame: {frame_of_mesh(registration, mesh)})"
    console.print(f"[bold]{out}[/]: report.html, registration.json{of_mesh}")
    if as_json:
        print(json.dumps(document))


def _unit(stated_unit: str | None, scans: list[Path]) -> str:
    from coupole.scan.registration.text_scans import HEADED_SUFFIXES
    from coupole.scan.scan import UNITS

    if stated_unit is None:
        unclear = next((path for path in scans if path.suffix.lower() in HEADED_SUFFIXES), None)
        if unclear is not None:
            raise InputError(f"{unclear}: some scanners write it in m, others in mm: state --unit")
        return "mm"
    if stated_unit not in UNITS:
        raise InputError(f"--unit {stated_unit}: expected one of {', '.join(UNITS)}")
    return stated_unit


def _refuse_cells(mesh_mm: float | None) -> None:
    if mesh_mm is not None and not mesh_mm > 0:
        raise InputError(f"--mesh-mm {mesh_mm:g}: expected cells of more than 0 mm")


def _merge_scans(
    registration: Registration, unit: str, mesh_mm: float | None, levels_mm: list[float], folder: Path, say: Say
) -> Merged:
    from coupole.scan.registration.merging import default_cell_mm, merge

    scans = [registration.scans[k] for k in registration.placed_numbers]
    cell_mm = mesh_mm or default_cell_mm(scans)
    poses = registration.merged_from_scan(cell_mm)
    return merge(scans, poses, unit, cell_mm, levels_mm, folder, say)


def _levels(text: str) -> list[float]:
    try:
        levels_mm = [float(word) for word in text.split(",") if word.strip()]
    except ValueError:
        levels_mm = [-1.0]
    if any(not 0 < level < 1e6 for level in levels_mm):
        raise InputError(f"--levels {text}: expected pitches in mm, separated by commas, such as 5,10,50,250")
    return levels_mm

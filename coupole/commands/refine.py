"""The command `coupole reflectance refine`: improves poses, lens and mesh from the disagreement of views."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import JsonOption, MeshOption, RecordsOption, fail
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError


@dataclass(frozen=True)
class StatedUncertainties:
    """Standard uncertainties that no record states, in mm and degrees."""

    arm_mm: Annotated[
        float,
        typer.Option(
            "--arm-mm", min=1e-4, help="Standard uncertainty of the flange's position, from view to view."
        ),
    ] = 0.03
    arm_deg: Annotated[
        float, typer.Option("--arm-deg", min=1e-5, help="Standard uncertainty of the flange's orientation.")
    ] = 0.003
    mesh_mm: Annotated[
        float, typer.Option("--mesh-mm", min=1e-4, help="Standard uncertainty of the mesh's position in the cell.")
    ] = 0.1
    mesh_deg: Annotated[
        float, typer.Option("--mesh-deg", min=1e-5, help="Standard uncertainty of the mesh's orientation.")
    ] = 0.02
    shape_mm: Annotated[
        float,
        typer.Option("--shape-mm", min=1e-4, help="Standard uncertainty of the mesh's surface along its normals."),
    ] = 0.03
    scale_mm: Annotated[
        float, typer.Option("--scale-mm", min=1.0, help="Correlation length of the errors of the surface.")
    ] = 20.0


@flatten_options
def refine(
    runs: Annotated[list[Path], typer.Argument(help="Runs of one object.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder for the result.", show_default=False)],
    mesh: MeshOption = None,
    calibrations: RecordsOption = None,
    search_mm: Annotated[
        float,
        typer.Option(
            "--search-mm", min=0.1, max=20.0, help="Largest disagreement between views that the search covers."
        ),
    ] = 3.0,
    *,
    stated: StatedUncertainties,
    as_json: JsonOption = False,
) -> None:
    """Measure how far apart views put the same spots of the surface. Then refine poses, lens and mesh together,
    within the uncertainties of records and scan, until the views agree.

    `coupole reflectance RUN... --refined OUT` uses the refined poses, lens and mesh.

    The options for flange, mesh and surface are standard uncertainties that no record states.
    """
    from coupole.calibration.record import records_named
    from coupole.reflectance.alignment.refine_job import RefineRequest, refine_runs
    from coupole.reflectance.extraction.pointing import Doubts
    from coupole.reflectance.result_pages import refinement_page
    from coupole.viewing.terminal import make_console, step_bars

    doubts = Doubts(**vars(stated))
    request = RefineRequest(tuple(runs), mesh, records_named(calibrations or []), doubts, search_mm)
    console = make_console(quiet=as_json)
    try:
        with step_bars(console) as say:
            about = refine_runs(request, out, say)
        page = refinement_page.write(out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    for remark in refinement_page.remarks(about):
        console.print(remark)
    console.print(f"report {page}")
    if as_json:
        print(json.dumps({name: value for name, value in about.items() if name != "inputs"}))

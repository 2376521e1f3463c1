"""The command `coupole plan suggest`: a plan for an object, with the expected uncertainty."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.commands.completion import mesh_units, supposed_materials
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError
from coupole.plan.shipped_files import SIMULATED_CELL, file_of

if TYPE_CHECKING:
    from coupole.reflectance.suggestion.plan_suggestion import SuggestionRequest

_READING = "reading mesh and cell"
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def seconds_of(text: str) -> float:
    """Seconds of a time such as `4h`, `90min` or `45 s`. Raises InputError."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min|h)\s*", text)
    if not match or not float(match[1]) > 0.0:
        raise InputError(f"--budget: expected a time such as 4h, 90min or 45s; found {text!r}")
    return float(match[1]) * _SECONDS[match[2]]


def to_middle_mm(mesh: Path, mm_per_unit: float) -> tuple[float, float, float]:
    """Return the translation, mm, that puts a mesh on the middle of the support. Raises InputError if the mesh
    cannot be read."""
    from coupole.scan.mesh_files import read_mesh

    points_mm = read_mesh(mesh, mesh.read_bytes()).vertices * mm_per_unit
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    return float(-(low[0] + high[0]) / 2), float(-(low[1] + high[1]) / 2), float(-low[2])


@dataclass(frozen=True)
class Wishes:
    """The options of a suggestion."""

    name: Annotated[
        str | None,
        typer.Option("--name", help="Name of the plan; by default the mesh's.", show_default=False),
    ] = None
    rig: Annotated[
        Path | None, typer.Option("--rig", help="The rig; by default the simulated cell.", show_default=False)
    ] = None
    calibrations: Annotated[
        list[Path] | None,
        typer.Option(
            "--calibrations",
            help="Records of the cell, or folders of them; by default those that the rig names.",
            show_default=False,
        ),
    ] = None
    material: Annotated[
        str,
        typer.Option(
            "--material",
            help="matt, glossy, metal, or unknown: any of the three.",
            autocompletion=supposed_materials,
        ),
    ] = "unknown"
    budget: Annotated[str, typer.Option("--budget", help="Time of the run, at most: 4h, 90min, 45s.")] = "1h"
    dose: Annotated[
        float | None,
        typer.Option("--dose", min=1e-6, help="Light that the object may receive, lux h.", show_default=False),
    ] = None
    views: Annotated[int, typer.Option("--views", min=1, max=200, help="Number of views, at most.")] = 24
    unit: Annotated[
        str, typer.Option("--unit", help="Unit of the mesh: mm, m or um.", autocompletion=mesh_units)
    ] = "mm"
    centre: Annotated[
        bool, typer.Option("--centre", help="Put the mesh on the middle of the support, wherever its origin is.")
    ] = False
    scan_noise_um: Annotated[
        float, typer.Option("--scan-noise", min=0.1, help="Noise of the mesh's vertices (standard), um.")
    ] = 30.0

    def file_stem(self, mesh: Path) -> str:
        """Name of the plan. If none is given, it is the name of the mesh, without characters that a name must not
        have."""
        return self.name or re.sub(r"[^A-Za-z0-9._-]", "-", mesh.stem).lstrip("._-")[:64] or "object"

    def request(self, mesh: Path) -> SuggestionRequest:
        """Return the request for a plan. Raises InputError for the first option that cannot be met.

        This is done before the mesh is read, and before imports that take seconds.
        """
        from coupole.plan.base_model import NAME_PATTERN
        from coupole.reflectance.suggestion.supposed_materials import SUPPOSED, UNKNOWN

        name, rig = self.file_stem(mesh), self.rig or SIMULATED_CELL
        if self.material not in (*SUPPOSED, UNKNOWN):
            raise InputError(f"--material: expected {', '.join(SUPPOSED)} or {UNKNOWN}; found {self.material!r}")
        if self.dose is not None and not math.isfinite(self.dose):
            raise InputError(f"--dose: expected a number of lux h; found {self.dose}; leave it out for no bound")
        seconds = seconds_of(self.budget)
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(f"--name: expected letters, digits, dots, hyphens and underscores; found {name!r}")
        for path in (Path(f"{name}.yaml"), Path(f"{name}.html")):
            if path.exists():
                raise InputError(f"{path}: exists already; choose another --name")
        if not mesh.is_file():
            raise InputError(f"{mesh}: no such file; expected the object's mesh, PLY, STL or OBJ")
        if not file_of(rig, "rigs").is_file():
            raise InputError(f"{rig}: no such file; name a rig with --rig")
        from coupole.preflight.object_shape import MM_PER_UNIT

        if self.unit not in MM_PER_UNIT:
            raise InputError(f"--unit: expected {', '.join(MM_PER_UNIT)}; found {self.unit!r}")
        from coupole.calibration.record import records_named
        from coupole.reflectance.suggestion.plan_suggestion import Budget, SuggestionRequest
        from coupole.reflectance.suggestion.plan_text import PlanText

        records = tuple(map(str, records_named(self.calibrations or [])))
        translation_mm = to_middle_mm(mesh, MM_PER_UNIT[self.unit]) if self.centre else None
        text = PlanText(name, str(rig), name, str(mesh), self.unit, records, translation_mm)
        budget = Budget(seconds, self.dose, self.views)
        return SuggestionRequest(text, Path(f"{name}.yaml"), self.material, budget, self.scan_noise_um)


@flatten_options
def plan_suggest(
    mesh: Annotated[Path, typer.Argument(help="The object's mesh: PLY, STL or OBJ.", show_default=False)],
    *,
    wishes: Wishes,
    as_json: JsonOption = False,
) -> None:
    """Write a plan for an object from its mesh, with the expected uncertainty, before anything is measured.

    Views, LEDs and exposures are chosen for an assumed material, within limits of time and light. NAME.yaml is the
    plan, NAME.html shows on the object how well normals and materials will be known.
    """
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        with step_bars(console) as say:
            say(_READING, 0, 1)  # reading and imports take the first seconds
            request = wishes.request(mesh)
            from coupole.reflectance.result_pages import suggestion_page
            from coupole.reflectance.suggestion.plan_suggestion import suggest_plan
            from coupole.storage.durable import write_synced

            suggestion = suggest_plan(request, say)
            say("page", 0, 1)
            page_path = request.path.with_suffix(".html")
            suggestion_page.write(page_path, request.text.name, suggestion)
            write_synced(request.path, suggestion.text)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps({"plan": str(request.path), "page": str(page_path), **suggestion.figures()}))
        return
    for line in suggestion_page.sentences(suggestion):
        console.print(line, markup=False)
    console.print(f"[bold]{request.path}[/]; {page_path} shows how well each part of the object will be known")

"""`coupole budget`: uncertainty of a reflectance, from calibration records."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.calibrating import EmissionOption, emission_of
from coupole.commands.common import JsonOption, fail
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError, StorageError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.budget.accuracy import Accuracy, Case
    from coupole.calibration.budget.budget import Budget, Geometry, Known, Spread
    from coupole.calibration.in_force import InForce

_SAMPLES = 24
CoverageOption = Annotated[
    list[float] | None,
    typer.Option(
        "--coverage",
        help="Coverage of an interval; repeat for more. By default 0.68 and 0.95.",
        min=0.01,
        max=0.99,
    ),
]


@dataclass(frozen=True)
class SpotOfObject:
    """Options of the measured spot: a triangle of the mesh, and the light on it."""

    incidence_deg: Annotated[
        float, typer.Option("--incidence", min=0.0, max=75.0, help="Angle of incidence of the light.")
    ] = 42.0
    vertex_um: Annotated[
        float, typer.Option("--vertex-um", min=0.0, help="Limit of the scanner's error at a vertex.")
    ] = 30.0
    edge_um: Annotated[float, typer.Option("--edge-um", min=1.0, help="Edge length of the mesh's triangles.")] = (
        200.0
    )
    pixels: Annotated[
        int, typer.Option("--pixels", min=1, help="Number of pixels of a triangle, per channel.")
    ] = 5
    contrast: Annotated[
        float, typer.Option("--contrast", min=0.0, help="Relative change of albedo per mm of the object.")
    ] = 0.02


@flatten_options
def budget(
    records: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Records, or folders of them: camera, hand-eye, leds, mesh, flat-field, response, "
            "led-power, drift, glare. Without a record, figures of Lucat et al. 2025 or assumed figures are used.",
            metavar="RECORD_OR_FOLDER",
        ),
    ] = None,
    plan: Annotated[
        Path | None, typer.Option("--plan", help="Add the records of other kinds that this plan names.")
    ] = None,
    beside: Annotated[
        list[Path] | None, typer.Option("--beside", help="Records of another cell, for a separate column.")
    ] = None,
    earlier: Annotated[
        list[Path] | None,
        typer.Option(
            "--earlier", help="Records of earlier calibrations, which show the figures that have drifted since."
        ),
    ] = None,
    *,
    spot: SpotOfObject,
    coverage: CoverageOption = None,
    emission: EmissionOption = "lambertian",
    out: Annotated[Path | None, typer.Option("--out", help="Write this PNG, and HTML and JSON beside it.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the uncertainty of a reflectance and its dominant sources, and compare the accuracies with the
    paper's.

    The intervals are by Monte Carlo (JCGM 101); the linear formula checks them.
    """
    from coupole.calibration.budget.budget import Geometry, Known
    from coupole.calibration.budget.propagation import COVERAGES
    from coupole.calibration.budget.records import read_records
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    start = Known(
        vertex_mm=spot.vertex_um / 1e3,
        edge_mm=spot.edge_um / 1e3,
        pixels=spot.pixels,
        contrast_per_mm=spot.contrast,
    )
    try:
        if out is not None:
            _refuse_target(out)
        all_records = _with_plan(read_records(records or []), plan)
        with console.status("propagating distributions"):
            result = _propagate(
                all_records, beside or [], start, Geometry(spot.incidence_deg), emission, coverage or COVERAGES
            ).with_doubts(_doubts_by_drift(all_records, earlier or []))
        if out is not None:
            _write_report(out, result)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    _say(result, console, as_json=as_json)


# -- helpers --------------------------------------------------------------------------------------------------


def _say(result: _Result, console: Console, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result.document))
        return
    _show(console, result.budget)
    _show_accuracies(console, result)


@dataclass(frozen=True)
class _Result:
    budget: Budget
    dome_spread: Spread
    """Spread over the dome by our own records."""
    cases: list[Case]
    """Our own records, then the records of `--beside`."""
    table: tuple[Accuracy, ...]
    doubts: tuple[str, ...]
    traces: tuple[str, ...]
    """Certificates to which our own records are traceable."""
    document: dict[str, Any]
    """Content of `--json`."""

    def with_doubts(self, more: tuple[str, ...]) -> _Result:
        """Return a copy with more reasons not to rely on the records."""
        all_doubts = (*self.doubts, *more)
        return replace(self, doubts=all_doubts, document=self.document | {"doubts": all_doubts})


def _doubts_by_drift(our_records: tuple[InForce, ...], earlier: list[Path]) -> tuple[str, ...]:
    """Return messages about records whose drift exceeds their uncertainty."""
    from coupole.calibration.in_force import read_in_force
    from coupole.calibration.record import records_named
    from coupole.calibration.validity import expired_by_drift

    return expired_by_drift(our_records, read_in_force(records_named(earlier)), datetime.now(UTC))


def _propagate(
    own_records: tuple[InForce, ...],
    beside: list[Path],
    start: Known,
    geometry: Geometry,
    emission: str,
    coverages: Sequence[float],
) -> _Result:
    """Compute the budget from our own records, and a table that compares these records with the records of
    `beside`."""
    from coupole.calibration.budget.accuracy import Case, accuracies
    from coupole.calibration.budget.budget import budget_of
    from coupole.calibration.budget.records import doubts, known_from, read_records, traces
    from coupole.calibration.budget.report import as_json as figures_of

    figures = known_from(own_records, start)
    our_budget = budget_of(figures, geometry, emission=emission_of(emission), coverages=coverages)
    our_spread = _spread_over_dome(figures)
    cases = [Case(_folder(own_records), own_records, our_spread)]
    if beside:
        their_records = read_records(beside)
        cases.append(
            Case(_folder(their_records), their_records, _spread_over_dome(known_from(their_records, start)))
        )
    table = accuracies(cases)
    doubts_of_records = doubts([item for case in cases for item in case.records], datetime.now(UTC))
    document = figures_of(our_budget, our_spread, cases, table)
    document |= {"doubts": doubts_of_records, "traceability": traces(own_records)}
    return _Result(our_budget, our_spread, cases, table, doubts_of_records, traces(own_records), document)


def _write_report(out: Path, result: _Result) -> None:
    """Write the picture, with HTML and JSON beside it."""
    from coupole.calibration.budget.page import page
    from coupole.calibration.budget.report import draw_budget

    picture = draw_budget(result.budget, result.dome_spread)
    text = page(
        result.budget, result.dome_spread, result.cases, result.table, picture, result.doubts, result.traces
    )
    _write(
        {
            out: picture,
            out.with_suffix(".html"): text.encode(),
            out.with_suffix(".json"): f"{json.dumps(result.document, indent=1)}\n".encode(),
        }
    )


def _with_plan(given_records: tuple[InForce, ...], plan: Path | None) -> tuple[InForce, ...]:
    """Return the given records, and for all other kinds the records in force for a plan."""
    from coupole.calibration.budget.records import of_use
    from coupole.preflight.job import read_job

    if plan is None:
        return given_records
    kinds = {item.record.kind for item in given_records}
    return given_records + tuple(
        item for item in of_use(read_job(plan).calibrations or ()) if item.record.kind not in kinds
    )


def _folder(records: tuple[InForce, ...]) -> str:
    """Heading of a column: the folder of the records."""
    return records[0].path.resolve().parent.name if records else "no records"


def _spread_over_dome(figures: Known) -> Spread:
    """Compute the budget for directions spread evenly over a dome, from the zenith to 20 degrees above the
    horizon."""
    from coupole.calibration.budget.budget import Geometry, spread_over

    steps = [(number + 0.5) / _SAMPLES for number in range(_SAMPLES)]
    cosines = [1.0 - step * (1.0 - math.cos(math.radians(70.0))) for step in steps]
    return spread_over(figures, [Geometry(math.degrees(math.acos(cosine))) for cosine in cosines])


def _refuse_target(out: Path) -> None:
    """Raise InputError if the name does not end in .png, or if the file exists already."""
    if out.suffix != ".png":
        raise InputError(f"--out {out}: expected the name of a PNG, as budget.png")
    for path in (out, out.with_suffix(".html"), out.with_suffix(".json")):
        if path.exists():
            raise InputError(f"{path}: exists already; choose another --out")


def _write(files: Mapping[Path, bytes]) -> None:
    for path, content in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise StorageError(f"{path}: cannot write the budget: {error.strerror}. Free its disk.") from error


def _show(console: Console, budget: Budget) -> None:
    from rich.table import Table

    from coupole.calibration.budget.page import verdict

    table = Table("source", "taken as", "said by", "alone", "variance", "without", box=None)
    for share in budget.shares:
        table.add_row(
            share.source,
            share.figure,
            share.said_by,
            f"{share.alone:.2%}",
            f"{share.linear:.1%}",
            f"{share.width_decrease:.1%}",
        )
    console.print(table)
    for interval in budget.numeric.intervals:
        if interval.kind == "symmetric":
            low, high = budget.relative(interval.coverage)
            short = budget.relative(interval.coverage, "shortest")
            console.print(
                f"{interval.coverage:.0%}: [{low:+.2%}, {high:+.2%}], shortest [{short[0]:+.2%}, {short[1]:+.2%}]"
            )
    console.print(
        "alone: half the 68 % interval from this source alone; variance: share of the variance by the linear "
        "formula;"
    )
    console.print("without: how much narrower the interval is without this source")
    console.print(
        f"linear formula: u {budget.linear.result.u / budget.nominal:.2%}; {budget.numeric.trials} trials"
    )
    for v in budget.validations:
        console.print(
            f"  linear formula at {v.coverage:.0%}, to digit {v.digits} of u (JCGM 101, section 8): {verdict(v)}"
        )


def _show_accuracies(console: Console, result: _Result) -> None:
    from rich.table import Table

    cases = result.cases
    table = Table(
        "accuracy",
        "Lucat et al. 2025",
        *(case.name for case in cases),
        box=None,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_row("robot's noise, found", "", *(case.robot for case in cases))
    for line in result.table:
        table.add_row(line.quantity, line.paper, *(line.cell(number) for number in range(len(cases))))
    console.print()
    console.print(table)
    console.print("standard uncertainties, all directions together; for samples over a dome, their 68 % intervals")
    for trace in result.traces:
        console.print(f"traceability: {trace}")
    for doubt in result.doubts:
        console.print(f"[yellow]{doubt}[/]")

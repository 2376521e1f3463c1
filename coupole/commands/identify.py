"""`coupole identify`: which pigment a reflectance spectrum shows."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from coupole.commands.common import JsonOption, fail
from coupole.commands.export_options import LedsOption, SensorOption
from coupole.commands.identify_options import ImageOptions, ReportOptions
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.appearance.spectra.spectra_library import LibrarySpectrum
    from coupole.heritage.analysis.identification import PigmentFinding
    from coupole.heritage.analysis.references import References
    from coupole.heritage.pigment_maps.line_points import LinePoints

_SHOWN = 3
_COLOURS = {"match": "green", "mixture": "green", "ambiguous": "yellow", "unknown": "yellow"}


SpectraArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Spectra: an instrument's export, a table with one spectrum in each row, a folder of such files, a "
        "table of points along a line (x_mm, y_mm, then wavelengths), or the header (.hdr) of an ENVI image cube.",
        metavar="SPECTRUM",
        show_default=False,
    ),
]
LibraryOption = Annotated[
    Path,
    typer.Option(
        "--library",
        help="Spectra of known pigments: a table with one spectrum in each row and the wavelengths "
        "in the first line or in spectra.txt beside it, or a folder of exports.",
        show_default=False,
    ),
]
ClassesOption = Annotated[
    Path | None,
    typer.Option(
        "--classes",
        help="Table of name, class and Colour Index name. By default the table that comes with "
        "Coupole for a library of this name: KremerHistorical, GamblinConservationColors, "
        "GretagMacbethMini, oilpaint.",
    ),
]
UnitOption = Annotated[
    Literal["auto", "percent", "fraction"],
    typer.Option("--unit", help="Unit of the spectra's reflectance, if their files do not state it."),
]
ResultOption = Annotated[
    Path | None,
    typer.Option("--result", help="A fitted result of runs instead of spectra, with --at.", show_default=False),
]
AtOption = Annotated[
    str | None,
    typer.Option("--at", help="Place X,Y,Z in mm on the exported mesh of --result.", show_default=False),
]


@dataclass(frozen=True)
class SpotOptions:
    """Options of a spot of a result, with the spectra that relate camera channels to a reflectance spectrum."""

    result: ResultOption = None
    at: AtOption = None
    sensor_spectra: SensorOption = None
    led_spectrum: LedsOption = None


@flatten_options
def identify(
    spectra: SpectraArgument = None,
    *,
    library: LibraryOption,
    classes: ClassesOption = None,
    unit: UnitOption = "auto",
    spot: SpotOptions,
    image: ImageOptions,
    report: ReportOptions,
    as_json: JsonOption = False,
) -> None:
    """Find which class of pigments each spectrum shows, or that the library has no class for it.

    A verdict is match, mixture, ambiguous or unknown. The class and its probability are printed beside every
    verdict. The last lines are the error rates with which the library identifies its own spectra. For an image
    cube, a map of classes is made. If it was interrupted, the same command continues.
    """
    from coupole.commands.identify_spot import asked_spot, identify_spot
    from coupole.scripting.analyses import references_of
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        report.refuse_half()
        spot_of_result = asked_spot(spot.result, spot.at, spot.sensor_spectra, spot.led_spectrum)
        if (spot_of_result is None) == (not spectra):
            raise InputError("expected spectra, or a spot of a result (--result, --at); found both or neither")
        if spot_of_result is not None:
            if report.report is not None:
                raise InputError(
                    "--report: expected spectra; three channels of a camera do not identify a "
                    "pigment well enough for a signed report"
                )
            document = identify_spot(spot_of_result, references_of(library, classes))
            console.print(f"{document['name']}: {document['verdict']}; {document['reason']}", markup=False)
            if as_json:
                print(json.dumps(document))
            return
        assert spectra is not None
        references = references_of(library, classes)
        for remark in references.remarks:
            console.print(remark, markup=False)
        if cube := _cube_among(spectra, image):
            from coupole.commands.identify_image import identify_cube

            document = identify_cube(console, cube, library, classes, references, image, report)
            if as_json:
                print(json.dumps(document))
            return
        documents, page = _identify_spectra(console, spectra, references, unit, report, (library, classes))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if page is not None:
        console.print(f"page: {page}", markup=False)
    if as_json:
        print(json.dumps(documents[0] if len(documents) == 1 else documents))


def _cube_among(paths: list[Path], options: ImageOptions) -> Path | None:
    """Return the cube among the arguments. Raises InputError for a cube among others, and for options of cubes
    without one."""
    from coupole.appearance.spectra.envi_cube import is_cube

    cubes = [path for path in paths if is_cube(path)]
    if cubes and len(paths) > 1:
        raise InputError(f"{cubes[0]}: expected one image cube and nothing else, found {len(paths)} arguments")
    if not cubes and options != ImageOptions():
        raise InputError("--mask, --area, --scale, --wavelength-unit, --regions: expected an image cube (.hdr)")
    return cubes[0] if cubes else None


def _identify_spectra(
    console: Console,
    paths: list[Path],
    references: References,
    unit: Any,
    report: ReportOptions,
    library: tuple[Path, Path | None],
) -> tuple[list[dict[str, Any]], Path | None]:
    """Identify spectra, or points along a line, print the findings, and write the report. Returns the findings as
    JSON's values, and the page."""
    from coupole.commands.identify_report import origin_of
    from coupole.heritage.pigment_maps.line_points import is_line, read_line
    from coupole.heritage.result_pages import identification_page
    from coupole.heritage.result_pages.line_profile import LineProfile

    line = None
    if any(is_line(path) for path in paths):
        if len(paths) > 1 or report.report is None:
            raise InputError(f"{paths[0]}: a line of points needs --report, and no other spectra beside it")
        line = read_line(paths[0], unit=unit)
    findings = _findings(console, paths, references, unit, line)
    page = None
    if report.report is not None:
        origin = origin_of(report, paths, *library, references)
        only = [finding for _, finding in findings]
        profile = None if line is None else LineProfile(line, only)
        page = identification_page.write(report.report, only, origin, profile)
    _show(console, [finding for _, finding in findings])
    return [_document_of(spectrum, finding, page) for spectrum, finding in findings], page


def _findings(
    console: Console, paths: list[Path], references: References, unit: Any, line: LinePoints | None
) -> list[tuple[LibrarySpectrum, PigmentFinding]]:
    from coupole.appearance.spectra.spectra_library import read_library
    from coupole.scripting.analyses import identify_spectra
    from coupole.viewing.terminal import step_bars

    library_spectra = (spectrum for path in paths for spectrum in read_library(path, unit=unit))
    spectra = list(library_spectra if line is None else line.spectra)
    with step_bars(console) as say:
        findings = identify_spectra(spectra, references, say)
    return list(zip(spectra, findings, strict=True))


def _show(console: Console, findings: list[PigmentFinding]) -> None:
    from rich.table import Table

    table = Table("spectrum", "verdict", "class", "probability", "not in library", box=None)
    for finding in findings:
        rows = [
            (candidate.class_name, f"{candidate.probability:.0%}") for candidate in finding.candidates[:_SHOWN]
        ]
        if finding.parts:
            rows = [
                (part.class_name, f"{part.share:.0%} of K/S ({part.interval[0]:.1%} to {part.interval[1]:.1%})")
                for part in finding.parts
            ]
        for number, (class_name, probability) in enumerate(rows):
            first = number == 0
            table.add_row(
                finding.name if first else "",
                f"[{_COLOURS[finding.verdict]}]{finding.verdict}[/]" if first else "",
                class_name,
                probability,
                f"{finding.not_in_library:.0%}" if first else "",
            )
    console.print(table)
    for finding in findings:
        console.print(f"{finding.name}: {'; '.join([finding.reason, *finding.remarks])}", markup=False)
    rates = findings[-1].rates
    console.print(
        f"the library's own spectra, each left out in turn (95 % intervals): first class right {rates.right}, "
        f"match with a wrong class {rates.false_matches}; with its whole class left out, the answer is unknown: "
        f"{rates.unknown}"
    )


def _document_of(spectrum: LibrarySpectrum, finding: PigmentFinding, page: Path | None) -> dict[str, Any]:
    from coupole.heritage.result_pages.identification_record import finding_document

    place = {"file": spectrum.file, "line": spectrum.line}
    return {**finding_document(finding), **place, "page": None if page is None else str(page.resolve())}

"""`coupole identify`: which pigment a reflectance spectrum shows."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from coupole.commands.common import JsonOption, fail
from coupole.commands.export_options import LedsOption, SensorOption
from coupole.commands.identify_spot import asked_spot, identify_spot
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.appearance.spectra.spectra_library import LibrarySpectrum
    from coupole.heritage.analysis.identification import PigmentFinding
    from coupole.heritage.analysis.references import Rate

_SHOWN = 3
_COLOURS = {"match": "green", "mixture": "green", "ambiguous": "yellow", "unknown": "yellow"}


SpectraArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Spectra: an instrument's export, a table with one spectrum in each row, or a folder of such files.",
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
PageOption = Annotated[
    Path | None, typer.Option("--report", help="Folder for a page with the curves and the evidence in each band.")
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
    report: PageOption = None,
    spot: SpotOptions,
    as_json: JsonOption = False,
) -> None:
    """Which class of pigments each spectrum shows, or that the library has none for it.

    A verdict is match, mixture, ambiguous or unknown. The class and its probability are printed beside every
    verdict. Below, the error rates of the library about its own spectra are printed.
    """
    from coupole.scripting.analyses import references_of
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        spot_of_result = asked_spot(spot.result, spot.at, spot.sensor_spectra, spot.led_spectrum)
        if (spot_of_result is None) == (not spectra):
            raise InputError("expected spectra, or a spot of a result (--result, --at); found both or neither")
        if spot_of_result is not None:
            document = identify_spot(spot_of_result, references_of(library, classes))
            console.print(f"{document['name']}: {document['verdict']}; {document['reason']}", markup=False)
            if as_json:
                print(json.dumps(document))
            return
        assert spectra is not None
        findings = _findings(console, spectra, library, classes, unit)
        page = None
        if report is not None:
            from coupole.heritage.result_pages.identification_page import write

            page = write(report, [finding for _, finding in findings], str(library))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    _show(console, [finding for _, finding in findings])
    if page is not None:
        console.print(f"page: {page}", markup=False)
    if as_json:
        documents = [_document_of(spectrum, finding, page) for spectrum, finding in findings]
        print(json.dumps(documents[0] if len(documents) == 1 else documents))


def _findings(
    console: Console, paths: list[Path], library: Path, classes: Path | None, unit: Any
) -> list[tuple[LibrarySpectrum, PigmentFinding]]:
    from coupole.appearance.spectra.spectra_library import read_library
    from coupole.scripting.analyses import identify_spectra, references_of
    from coupole.viewing.terminal import step_bars

    spectra = [spectrum for path in paths for spectrum in read_library(path, unit=unit)]
    references = references_of(library, classes)
    for remark in references.remarks:
        console.print(remark, markup=False)
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
    evidence, rates = finding.evidence, finding.rates
    return {
        "name": finding.name,
        "file": spectrum.file,
        "line": spectrum.line,
        "verdict": finding.verdict,
        "class": finding.class_name,
        "candidates": [
            {"name": candidate.name, "class": candidate.class_name, "probability": candidate.probability}
            for candidate in finding.candidates
        ],
        "not_in_library": finding.not_in_library,
        "mixture": [
            {"name": part.name, "class": part.class_name, "share": part.share, "interval": list(part.interval)}
            for part in finding.parts
        ],
        "reason": finding.reason,
        "remarks": list(finding.remarks),
        "evidence": {
            "wavelengths_nm": evidence.wavelengths_nm.tolist(),
            "log_odds_first_against_second": evidence.log_odds.tolist(),
        },
        "near_infrared": finding.near_infrared,
        "held_out": {
            "first_class_right": _rate(rates.right),
            "match_right": _rate(rates.matches),
            "match_wrong": _rate(rates.false_matches),
            "unknown_without_the_class": _rate(rates.unknown),
        },
        "page": None if page is None else str(page.resolve()),
    }


def _rate(rate: Rate) -> dict[str, Any]:
    return {"count": rate.count, "of": rate.of, "interval_95": list(rate.interval)}

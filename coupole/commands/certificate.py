"""`coupole certificate`: a certificate of the whole cell."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CalibrationRefused, CoupoleError, InputError, StorageError, reason

if TYPE_CHECKING:
    from rich.console import Console


def certificate(
    records: Annotated[
        list[Path],
        typer.Argument(help="Records in force, or folders of them.", metavar="RECORD_OR_FOLDER..."),
    ],
    about: Annotated[
        Path,
        typer.Option(
            "--about",
            help="Statements of the laboratory (YAML): item, place, climate, and the person who authorises.",
            show_default=False,
        ),
    ],
    earlier: Annotated[
        list[Path] | None,
        typer.Option("--earlier", help="Records of earlier calibrations, which show how fast figures drift."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Write this page, and JSON beside it.")] = Path(
        "certificate.html"
    ),
    as_json: JsonOption = False,
) -> None:
    """Write a certificate of a cell: results with U, conditions, and chain to certificates (ISO/IEC 17025, 7.8).

    The exit code is 3 if a record is not accepted, has expired by date or by drift, or is not traceable.
    """
    from coupole.calibration.budget.records import doubts
    from coupole.calibration.certificate.chain import chain_of
    from coupole.calibration.certificate.page import CellCertificate, certificate_page, document_of
    from coupole.calibration.certificate.statements import read_description
    from coupole.calibration.in_force import read_in_force
    from coupole.calibration.record import records_named
    from coupole.calibration.validity import expired_by_drift
    from coupole.pages.page_rendering import write_page
    from coupole.viewing.terminal import make_console

    console, now = make_console(quiet=as_json), datetime.now(UTC)
    try:
        _refuse_out(out)
        chain = chain_of(records)
        if not chain:
            raise InputError(f"{', '.join(map(str, records))}: expected records of calibrations, found none")
        items = [link.item for link in chain]
        drift_doubts = expired_by_drift(items, read_in_force(records_named(earlier or [])), now)
        gaps = [gap for link in chain for gap in link.gaps]
        all_doubts = tuple(dict.fromkeys([*doubts(items, now), *drift_doubts, *gaps]))
        cell_certificate = CellCertificate(read_description(about), chain, now.replace(microsecond=0), all_doubts)
        write_page(out, certificate_page(cell_certificate))
        _write_json(out.with_suffix(".json"), document_of(cell_certificate))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(document_of(cell_certificate)))
    console.print(f"certificate {out}, {len(chain)} records")
    _refuse_doubtful(out, all_doubts, console)


def _refuse_doubtful(out: Path, all_doubts: tuple[str, ...], console: Console) -> None:
    """Print the reasons for doubt. Raises CalibrationRefused if there is one."""
    for doubt in all_doubts:
        console.print(f"[yellow]{doubt}[/]")
    if all_doubts:
        raise CalibrationRefused([f"{out}: not to be issued: {doubt}" for doubt in all_doubts])


def _refuse_out(out: Path) -> None:
    """Raise InputError if the name does not end in .html, or if the file exists."""
    if out.suffix != ".html":
        raise InputError(f"--out {out}: expected the name of a page, such as certificate.html")
    for path in (out, out.with_suffix(".json")):
        if path.exists():
            raise InputError(f"{path}: exists already; choose another --out")


def _write_json(path: Path, document: dict[str, object]) -> None:
    try:
        path.write_text(f"{json.dumps(document, indent=1)}\n", encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{path}: cannot write the certificate: {reason(error)}. Free its disk.") from error

"""Options of the report of `coupole identify`: object, instrument, persons, licence, signature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import LONGEST_NAME
from coupole.errors import InputError

if TYPE_CHECKING:
    from coupole.heritage.analysis.references import References
    from coupole.heritage.result_pages.identification_record import Origin

_PANEL = "Report"

PageOption = Annotated[
    Path | None,
    typer.Option(
        "--report",
        help="Folder for a report to sign: page, record, and the maps of an image or a line, which need it.",
        rich_help_panel=_PANEL,
    ),
]
ObjectOption = Annotated[str | None, typer.Option("--object", help="Object.", rich_help_panel=_PANEL)]
SampleOption = Annotated[
    str | None, typer.Option("--sample", help="Sample, point or area.", rich_help_panel=_PANEL)
]
InstrumentOption = Annotated[str | None, typer.Option("--instrument", help="Instrument.", rich_help_panel=_PANEL)]
MeasuredByOption = Annotated[
    str | None, typer.Option("--measured-by", help="Person who measured.", rich_help_panel=_PANEL)
]
MeasuredOnOption = Annotated[
    str | None, typer.Option("--measured-on", help="Date of the measurement.", rich_help_panel=_PANEL)
]
SimulatedOption = Annotated[
    bool, typer.Option("--simulated", help="The data are simulated; the report says so.", rich_help_panel=_PANEL)
]
LicenceOption = Annotated[
    str | None,
    typer.Option(
        "--library-licence",
        help="Licence of the library, if no file LICENSE is beside it.",
        rich_help_panel=_PANEL,
    ),
]
SignedByOption = Annotated[
    str | None, typer.Option("--signed-by", help="Person who signs the report.", rich_help_panel=_PANEL)
]
RoleOption = Annotated[str | None, typer.Option("--role", help="Role of this person.", rich_help_panel=_PANEL)]


@dataclass(frozen=True)
class ReportOptions:
    """Words of a report besides the findings."""

    report: PageOption = None
    object_name: ObjectOption = None
    sample: SampleOption = None
    instrument: InstrumentOption = None
    measured_by: MeasuredByOption = None
    measured_on: MeasuredOnOption = None
    is_simulated: SimulatedOption = False
    library_licence: LicenceOption = None
    signed_by: SignedByOption = None
    role: RoleOption = None

    def refuse_half(self) -> None:
        """Raise InputError for a signature without a role, or for options of a report without `--report`."""
        if (self.signed_by is None) != (self.role is None):
            raise InputError("expected --signed-by and --role together, found one of them")
        for option, words in (("--signed-by", self.signed_by), ("--role", self.role)):
            if words is not None and not 0 < len(words.strip()) <= LONGEST_NAME:
                raise InputError(f"{option}: expected 1 to {LONGEST_NAME} characters, found {len(words.strip())}")
        if self.report is None and (self != ReportOptions()):
            raise InputError("expected --report with a folder; the other options of a report go with it")


def origin_of(
    options: ReportOptions,
    inputs: Sequence[Path],
    library: Path,
    classes: Path | None,
    references: References,
    header_fields: Mapping[str, object] | None = None,
) -> Origin:
    """Gather what is known about inputs and library. Options precede what the files say. Of an image cube,
    `header_fields` are those of its header. Raises InputError."""
    from coupole.appearance.spectra.spectra_library import library_files
    from coupole.heritage.pigment_maps import spectra_origin
    from coupole.heritage.result_pages.identification_record import LibraryFacts, Origin, signature_of

    facts: dict[str, str] = {}
    is_simulated = options.is_simulated
    if header_fields is not None:
        facts, is_called_so = spectra_origin.header_facts(header_fields)
        is_simulated |= is_called_so
    else:
        of_files = [spectra_origin.file_facts(file) for path in inputs for file in library_files(path)]
        is_simulated |= any(is_called_so for _, is_called_so in of_files)
        for name in {name for file_facts, _ in of_files for name in file_facts}:
            words = dict.fromkeys(file_facts[name] for file_facts, _ in of_files if name in file_facts)
            facts[name] = "; ".join(words)
    option_words = (
        options.object_name,
        options.sample,
        options.instrument,
        options.measured_by,
        options.measured_on,
    )
    facts |= {name: words for name, words in zip(spectra_origin.FACTS, option_words, strict=True) if words}
    files = spectra_origin.digests([library])
    table = "tables that come with Coupole"
    if classes is not None:
        files |= spectra_origin.digests([classes])
        table = classes.name
    signature = None
    if options.signed_by is not None and options.role is not None:
        signature = signature_of(options.signed_by.strip(), options.role.strip())
    return Origin(
        spectra_origin.digests(inputs),
        LibraryFacts(
            library.name,
            files,
            len(references.names),
            len(set(references.class_of)),
            table,
            options.library_licence or spectra_origin.licence_beside(library),
        ),
        facts,
        is_simulated,
        signature,
    )

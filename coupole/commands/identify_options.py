"""Options of `coupole identify` for image cubes and for the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from coupole.commands.common import LONGEST_NAME
from coupole.errors import InputError

_IMAGE = "Image cubes"
_REPORT = "Report"

MaskOption = Annotated[
    Path | None,
    typer.Option("--mask", help="Picture of the cube's size; black pixels are left out.", rich_help_panel=_IMAGE),
]
AreaOption = Annotated[
    str | None,
    typer.Option(
        "--area",
        help="Rows and columns FIRST:END,FIRST:END, counted from 0; END is left out.",
        rich_help_panel=_IMAGE,
    ),
]
ScaleOption = Annotated[
    float | None,
    typer.Option("--scale", help="Number in the cube that stands for a reflectance of 1.", rich_help_panel=_IMAGE),
]
WavelengthOption = Annotated[
    Literal["nm", "um"] | None,
    typer.Option("--wavelength-unit", help="Unit of the header's wavelengths.", rich_help_panel=_IMAGE),
]
RegionsOption = Annotated[
    int, typer.Option("--regions", min=2, max=200, help="Most regions of like spectra.", rich_help_panel=_IMAGE)
]


@dataclass(frozen=True)
class ImageOptions:
    """Options of an image cube."""

    mask: MaskOption = None
    area: AreaOption = None
    scale: ScaleOption = None
    wavelength_unit: WavelengthOption = None
    regions: RegionsOption = 40


PageOption = Annotated[
    Path | None,
    typer.Option(
        "--report",
        help="Folder for a report to sign: page, record, and maps of an image or a line. Images and "
        "lines need this option.",
        rich_help_panel=_REPORT,
    ),
]
ObjectOption = Annotated[str | None, typer.Option("--object", help="Object.", rich_help_panel=_REPORT)]
SampleOption = Annotated[
    str | None, typer.Option("--sample", help="Sample, point or area.", rich_help_panel=_REPORT)
]
InstrumentOption = Annotated[str | None, typer.Option("--instrument", help="Instrument.", rich_help_panel=_REPORT)]
MeasuredByOption = Annotated[
    str | None, typer.Option("--measured-by", help="Person who measured.", rich_help_panel=_REPORT)
]
MeasuredOnOption = Annotated[
    str | None, typer.Option("--measured-on", help="Date of the measurement.", rich_help_panel=_REPORT)
]
SimulatedOption = Annotated[
    bool, typer.Option("--simulated", help="The data are simulated; the report says so.", rich_help_panel=_REPORT)
]
LicenceOption = Annotated[
    str | None,
    typer.Option(
        "--library-licence",
        help="Licence of the library, if no file LICENSE is beside it.",
        rich_help_panel=_REPORT,
    ),
]
SignedByOption = Annotated[
    str | None, typer.Option("--signed-by", help="Person who signs the report.", rich_help_panel=_REPORT)
]
RoleOption = Annotated[str | None, typer.Option("--role", help="Role of this person.", rich_help_panel=_REPORT)]


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

"""The options of `coupole export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import RecordsOption
from coupole.commands.completion import formats, materials
from coupole.exchange.formats import FORMATS, MAPS, Source, formats_of
from coupole.reflectance.fits import MATERIALS, OF_TEXELS

_COLOUR, _PARTS, _ABOUT = "Colour of frames (dng, tiff)", "What is exported", "Metadata of the crate (rocrate)"
_OF_MATERIALS = [name for name, export_format in FORMATS.items() if "triangle" in export_format.options]
_WITH_MAPS = [name for name, export_format in FORMATS.items() if MAPS[0] in export_format.options]
_SHOWN = "Display of views (relight, iiif)"

ToOption = Annotated[
    str,
    typer.Option(
        "--to",
        help=f"For runs: {', '.join(formats_of(Source.RUN))}. "
        f"For results of runs: {', '.join(formats_of(Source.RESULT))}; "
        f"for results of pictures: {', '.join(formats_of(Source.PICTURES))}; "
        f"for restorations: {', '.join(formats_of(Source.RESTORATION))}.",
        show_default=False,
        autocompletion=formats,
    ),
]
ViewsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--views", help="For runs: names of views, with * and ?; repeat for more.", rich_help_panel=_PARTS
    ),
]
ShotsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--shots", help="For runs: labels of shots, such as `led04*/e0`; repeat for more.", rich_help_panel=_PARTS
    ),
]
FitOption = Annotated[
    str | None,
    typer.Option(
        "--fit",
        autocompletion=materials,
        help=f"For results: {', '.join(MATERIALS)}; for formats with maps also {' or '.join(OF_TEXELS)}. By "
        "default the fit with the smallest error in the check; never shared materials.",
        rich_help_panel=_PARTS,
    ),
]
TriangleOption = Annotated[
    list[int] | None,
    typer.Option(
        "--triangle",
        help=f"For results, with {', '.join(_OF_MATERIALS)}: number of a triangle; repeat for more.",
        min=0,
        rich_help_panel=_PARTS,
    ),
]
AdaptiveOption = Annotated[
    float | None,
    typer.Option(
        "--adaptive",
        metavar="ERROR",
        help="For bsdf: largest error of the table against the fit, as a share such as 0.003. It holds for 95 % "
        "of all directions, and for 95 % of the directions in the lobe. The smallest such table "
        "is written; by default a "
        "table of 17 MB.",
        min=1e-5,
        max=0.5,
        show_default=False,
        rich_help_panel=_PARTS,
    ),
]
TexelOption = Annotated[
    float | None,
    typer.Option(
        "--texel-mm",
        metavar="MM",
        help=f"For {', '.join(_WITH_MAPS)}: width of the maps' texels on the object; by default the width of the "
        "finest view's pixels, or larger if the maps would be too large.",
        min=1e-4,
        show_default=False,
        rich_help_panel=_PARTS,
    ),
]
MapOption = Annotated[
    int | None,
    typer.Option(
        "--map-px",
        metavar="PX",
        help="For the formats of --texel-mm: greatest width and height of the maps, from 256 to 16384, which is "
        "the default.",
        min=256,
        max=16384,
        show_default=False,
        rich_help_panel=_PARTS,
    ),
]
UvOption = Annotated[
    Path | None,
    typer.Option(
        "--uv",
        metavar="MESH",
        help="For the formats of --texel-mm: the mesh with texture coordinates (.obj, .ply, .glb), in which the "
        "maps are laid out; by default new charts are made.",
        rich_help_panel=_PARTS,
    ),
]
RefinedOption = Annotated[
    Path | None,
    typer.Option(
        "--refined",
        help="For colmap: folder of `coupole reflectance refine`; its poses, lens and mesh are used.",
        rich_help_panel=_PARTS,
    ),
]
SensorOption = Annotated[
    Path | None,
    typer.Option(
        "--sensor-spectra",
        help="Table of the sensor's spectral sensitivities: nm, red, green, blue.",
        rich_help_panel=_COLOUR,
    ),
]
LedsOption = Annotated[
    Path | None,
    typer.Option(
        "--led-spectrum",
        help="Table of the LEDs' spectrum: nm, power; by default the rig's dome.spectrum.",
        rich_help_panel=_COLOUR,
    ),
]
EyeOption = Annotated[
    bool,
    typer.Option(
        "--for-the-eye",
        help="Write TIFF in sRGB, 16 bit, instead of the camera's values; needs --sensor-spectra.",
        rich_help_panel=_COLOUR,
    ),
]
LinearOption = Annotated[
    bool,
    typer.Option(
        "--linear",
        help="With --for-the-eye: linear values, without sRGB's curve; the file's profile says so.",
        rich_help_panel=_COLOUR,
    ),
]
LicenceOption = Annotated[
    str | None,
    typer.Option(
        "--licence", help="URL of the licence, or its text; by default the plan's licence.", rich_help_panel=_ABOUT
    ),
]
AuthorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--author",
        help="'NAME <https://orcid.org/...> at INSTITUTION'; repeat for more.",
        rich_help_panel=_ABOUT,
    ),
]
PublisherOption = Annotated[
    str | None, typer.Option("--publisher", help="Name of the publisher.", rich_help_panel=_ABOUT)
]
NameOption = Annotated[
    str | None, typer.Option("--name", help="Title; by default the folder's name.", rich_help_panel=_ABOUT)
]
IdentifierOption = Annotated[str | None, typer.Option("--identifier", help="A DOI.", rich_help_panel=_ABOUT)]
InPlaceOption = Annotated[
    bool,
    typer.Option(
        "--in-place", help="Write the metadata into SOURCE; no file is linked or copied.", rich_help_panel=_ABOUT
    ),
]


BasisOption = Annotated[
    str | None,
    typer.Option(
        "--basis",
        help="For relight: bilinear (default), rbf, ptm or hsh.",
        rich_help_panel=_SHOWN,
    ),
]
PlanesOption = Annotated[
    int | None,
    typer.Option(
        "--planes",
        help="For relight with bilinear or rbf: 27 (default) or 18.",
        rich_help_panel=_SHOWN,
    ),
]
BaseUrlOption = Annotated[
    str | None,
    typer.Option(
        "--base-url",
        help="For iiif: the address at which the folder will be served; the ids in the files begin "
        "with it. By default they begin with https://example.org/iiif, where no viewer finds "
        "the pictures.",
        rich_help_panel=_SHOWN,
    ),
]


@dataclass(frozen=True)
class ExportOptions:
    """Options that apply only to some formats and sources."""

    views: ViewsOption = None
    shots: ShotsOption = None
    fit: FitOption = None
    triangle: TriangleOption = None
    adaptive: AdaptiveOption = None
    texel_mm: TexelOption = None
    map_px: MapOption = None
    uv: UvOption = None
    refined: RefinedOption = None
    calibrations: RecordsOption = None
    sensor_spectra: SensorOption = None
    led_spectrum: LedsOption = None
    for_the_eye: EyeOption = False
    linear: LinearOption = False
    licence: LicenceOption = None
    author: AuthorOption = None
    publisher: PublisherOption = None
    name: NameOption = None
    identifier: IdentifierOption = None
    in_place: InPlaceOption = False
    basis: BasisOption = None
    planes: PlanesOption = None
    base_url: BaseUrlOption = None

    def given_options(self) -> dict[str, object]:
        """Return the given options by their names on the command line, without the leading dashes."""
        return {
            name.replace("_", "-"): value
            for name, value in vars(self).items()
            if value is not False and value not in (None, [])
        }

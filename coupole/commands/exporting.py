"""The command `coupole export`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, RecordsOption, fail, records_named
from coupole.errors import CoupoleError, InputError
from coupole.exchange import COLMAP, CRATE, FORMATS, RTI
from coupole.exchange.of_results import FORMATS as OF_RESULTS
from coupole.exchange.of_results import OF_MATERIALS

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.exchange.run_colour import ColourWanted

OF_RUNS = (*FORMATS, RTI, COLMAP, CRATE)
_COLOUR, _PARTS, _ABOUT = "Colour of frames (dng, tiff)", "What is exported", "What the crate says (rocrate)"

ToOption = Annotated[
    str,
    typer.Option(
        "--to",
        help=f"Of runs: {', '.join(OF_RUNS)}. Of results: {', '.join((*OF_RESULTS, CRATE))}.",
        show_default=False,
    ),
]
ViewsOption = Annotated[
    list[str] | None,
    typer.Option("--views", help="Of runs: names, with * and ?; again for more.", rich_help_panel=_PARTS),
]
ShotsOption = Annotated[
    list[str] | None,
    typer.Option("--shots", help="Of runs: labels, as `led04*/e0`; again for more.", rich_help_panel=_PARTS),
]
FitOption = Annotated[
    str | None,
    typer.Option(
        "--fit", help="Of results: ggx or ggx_normal; without it what missed least.", rich_help_panel=_PARTS
    ),
]
TriangleOption = Annotated[
    list[int] | None,
    typer.Option(
        "--triangle",
        help=f"Of results, for {', '.join(OF_MATERIALS)}: its number; again for more.",
        min=0,
        rich_help_panel=_PARTS,
    ),
]
RefinedOption = Annotated[
    Path | None,
    typer.Option(
        "--refined",
        help="For colmap: folder of `coupole reflectance refine`, whose poses, lens and mesh hold.",
        rich_help_panel=_PARTS,
    ),
]
SensorOption = Annotated[
    Path | None,
    typer.Option(
        "--sensor-spectra",
        help="Table of nm, red, green, blue: the sensor's sensitivities.",
        rich_help_panel=_COLOUR,
    ),
]
LedsOption = Annotated[
    Path | None,
    typer.Option(
        "--led-spectrum",
        help="Table of nm, power; without it the rig's dome.spectrum.",
        rich_help_panel=_COLOUR,
    ),
]
EyeOption = Annotated[
    bool,
    typer.Option(
        "--for-the-eye",
        help="TIFF of sRGB, 16 bit, in place of the camera's numbers; needs --sensor-spectra.",
        rich_help_panel=_COLOUR,
    ),
]
LinearOption = Annotated[
    bool,
    typer.Option(
        "--linear", help="With --for-the-eye: without sRGB's curve, as its profile says.", rich_help_panel=_COLOUR
    ),
]
LicenceOption = Annotated[
    str | None,
    typer.Option("--licence", help="Its URL, or words; without it the plan's.", rich_help_panel=_ABOUT),
]
AuthorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--author",
        help="'NAME <https://orcid.org/...> at HOUSE'; again for more.",
        rich_help_panel=_ABOUT,
    ),
]
PublisherOption = Annotated[str | None, typer.Option("--publisher", help="Its name.", rich_help_panel=_ABOUT)]
NameOption = Annotated[
    str | None, typer.Option("--name", help="Title; without it the folder's name.", rich_help_panel=_ABOUT)
]
IdentifierOption = Annotated[str | None, typer.Option("--identifier", help="A DOI.", rich_help_panel=_ABOUT)]
InPlaceOption = Annotated[
    bool,
    typer.Option(
        "--in-place", help="Write the metadata into SOURCE; no file is linked or copied.", rich_help_panel=_ABOUT
    ),
]


@dataclass(frozen=True)
class Asked:
    """What the options say; those that were not given are empty."""

    source: Path
    to: str
    out: Path
    overwrite: bool
    options: dict[str, object]
    """By name, only those that were given."""

    def refuse(self, names: tuple[str, ...], why: str) -> None:
        """Raise InputError if one of these options was given."""
        if any(name in self.options for name in names):
            raise InputError(f"{', '.join(f'--{name}' for name in names)}: {why}")

    def texts(self, name: str) -> list[str]:
        found = self.options.get(name, [])
        assert isinstance(found, list)
        return list(map(str, found))

    def text(self, name: str) -> str | None:
        found = self.options.get(name)
        return None if found is None else str(found)

    def path(self, name: str) -> Path | None:
        found = self.options.get(name)
        return found if isinstance(found, Path) else None

    @property
    def records(self) -> tuple[Path, ...]:
        return records_named([Path(text) for text in self.texts("calibrations")])


_OF_FRAMES, _OF_A_RESULT = ("views", "shots"), ("fit", "triangle")
_OF_COLOUR = ("sensor-spectra", "led-spectrum", "for-the-eye", "linear")
_OF_A_CRATE = ("licence", "author", "publisher", "name", "identifier", "in-place")


def export(
    source: Annotated[Path, typer.Argument(help="A run's folder, or a result's.", show_default=False)],
    to: ToOption,
    views: ViewsOption = None,
    shots: ShotsOption = None,
    fit: FitOption = None,
    triangle: TriangleOption = None,
    refined: RefinedOption = None,
    calibrations: RecordsOption = None,
    sensor_spectra: SensorOption = None,
    led_spectrum: LedsOption = None,
    for_the_eye: EyeOption = False,
    linear: LinearOption = False,
    licence: LicenceOption = None,
    author: AuthorOption = None,
    publisher: PublisherOption = None,
    name: NameOption = None,
    identifier: IdentifierOption = None,
    in_place: InPlaceOption = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder; SOURCE/export if not given.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite existing files.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a run's proven frames, its views, or a result of reflectance, as other programs read them."""
    from coupole.viewing.terminal import bytes_text, make_console

    given = {
        "views": views, "shots": shots, "fit": fit, "triangle": triangle, "refined": refined,
        "calibrations": calibrations, "sensor-spectra": sensor_spectra, "led-spectrum": led_spectrum,
        "for-the-eye": for_the_eye, "linear": linear, "licence": licence, "author": author,
        "publisher": publisher, "name": name, "identifier": identifier, "in-place": in_place,
    }  # fmt: skip
    folder = source if in_place else out or source / "export"
    asked = Asked(source, to, folder, overwrite, {key: value for key, value in given.items() if value})
    if triangle:
        asked.options["triangle"] = triangle
    console = make_console(quiet=as_json)
    try:
        files, size = _written(asked, console)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    console.print(f"{files} files, {bytes_text(size)}, in {folder}")
    if as_json:
        print(json.dumps({"out": str(folder.resolve()), "files": files, "bytes": size}))


def _written(asked: Asked, console: Console) -> tuple[int, int]:
    """Number and size of the files."""
    is_result = (asked.source / "object.h5").exists()
    if is_result:
        asked.refuse(_OF_FRAMES, "are for the frames of a run; this is a result")
    elif (asked.source / "normals.npy").exists():
        raise InputError(f"{asked.source}: is a result of pictures, which has no surface; `coupole show` shows it")
    else:
        asked.refuse(_OF_A_RESULT, "are for results of reflectance; this is a run")
    if asked.to != CRATE:
        asked.refuse(_OF_A_CRATE, f"are for --to {CRATE}")
    if is_result or asked.to not in FORMATS:
        asked.refuse(_OF_COLOUR, "are for frames of a run as dng or tiff")
    if asked.to != COLMAP:
        asked.refuse(("refined",), f"is for --to {COLMAP}")
        if asked.to not in FORMATS:
            asked.refuse(("calibrations",), f"is for {COLMAP}, and for colour of frames")
    match asked.to:
        case "rocrate":
            return _export_crate(asked, console)
        case _ if is_result:
            return _export_result(asked, console)
        case "lp":
            return _export_rti(asked, console)
        case "colmap":
            return _export_colmap(asked, console)
        case _:
            return _export_frames(asked, console)


def _export_result(asked: Asked, console: Console) -> tuple[int, int]:
    from coupole.exchange.of_results.export_result import export_result

    triangles = tuple(map(int, asked.texts("triangle")))
    with console.status(f"writing {asked.to}"):
        paths = export_result(
            asked.source,
            asked.to,
            asked.out,
            fit=asked.text("fit"),
            triangles=triangles,
            overwrite=asked.overwrite,
        )
    return _sizes(paths)


def _export_rti(asked: Asked, console: Console) -> tuple[int, int]:
    from coupole.exchange.rti_pictures import export_rti

    asked.refuse(("shots",), "are for single frames; of RTI all LEDs of a view are written")
    views = asked.texts("views")
    return _sizes(
        _with_bars(
            console, lambda say: export_rti(asked.source, asked.out, views, overwrite=asked.overwrite, say=say)
        )
    )


def _export_colmap(asked: Asked, console: Console) -> tuple[int, int]:
    from coupole.exchange.colmap import export_colmap

    asked.refuse(_OF_FRAMES, f"are for single frames; {COLMAP} has all views")
    return _sizes(
        _with_bars(
            console,
            lambda say: export_colmap(
                asked.source,
                asked.out,
                records=asked.records,
                refined=asked.path("refined"),
                overwrite=asked.overwrite,
                say=say,
            ),
        )
    )


def _export_crate(asked: Asked, console: Console) -> tuple[int, int]:
    from coupole.exchange.research_crate import CrateFacts, write_crate

    asked.refuse((*_OF_FRAMES, *_OF_A_RESULT), f"are for parts; {CRATE} has all files")
    facts = CrateFacts(
        asked.text("licence"),
        tuple(asked.texts("author")),
        asked.text("publisher"),
        asked.text("name"),
        asked.text("identifier"),
    )
    in_place = "in-place" in asked.options
    return _sizes(
        _with_bars(
            console,
            lambda say: write_crate(
                asked.source, asked.out, facts, in_place=in_place, overwrite=asked.overwrite, say=say
            ),
        )
    )


def _export_frames(asked: Asked, console: Console) -> tuple[int, int]:
    from rich.progress import Progress

    from coupole.exchange.export import export_run
    from coupole.storage.run import Run

    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("export")
        found = export_run(
            Run(asked.source),
            asked.to,
            asked.out,
            views=asked.texts("views"),
            shots=asked.texts("shots"),
            colour=_colour_of(asked),
            linear="linear" in asked.options,
            overwrite=asked.overwrite,
            progress=lambda done, total: bars.update(bar, completed=done, total=total),
        )
    return found.files, found.bytes


def _colour_of(asked: Asked) -> ColourWanted | None:
    """Raises InputError for options that do not go together."""
    from coupole.exchange.run_colour import ColourWanted

    eye, sensor = "for-the-eye" in asked.options, asked.path("sensor-spectra")
    if eye and asked.to != "tiff":
        raise InputError(f"--for-the-eye: is for --to tiff; a {asked.to} with --sensor-spectra has its colours")
    if not eye:
        asked.refuse(("linear",), "goes with --for-the-eye")
        if asked.to == "tiff":
            asked.refuse(("sensor-spectra", "led-spectrum"), "are for --for-the-eye, or for --to dng")
    if sensor is None:
        if eye or "led-spectrum" in asked.options or "calibrations" in asked.options:
            raise InputError("--sensor-spectra: expected a table of nm, red, green, blue, from the sensor's maker")
        return None
    return ColourWanted(sensor, asked.path("led-spectrum"), asked.records)


def _with_bars(console: Console, write: Callable[[Callable[[str, int, int], None]], list[Path]]) -> list[Path]:
    from coupole.viewing.terminal import step_bars

    with step_bars(console) as bars:
        return write(bars)


def _sizes(paths: list[Path]) -> tuple[int, int]:
    return len(paths), sum(path.stat().st_size for path in paths)

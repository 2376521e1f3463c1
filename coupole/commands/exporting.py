"""The command `coupole export`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail, records_named
from coupole.commands.export_formats import OF_PICTURES, OF_RESULTS_OF_RUNS, OF_RUNS
from coupole.commands.export_options import ExportOptions, ToOption
from coupole.commands.option_groups import flattened
from coupole.errors import CoupoleError, InputError
from coupole.exchange import COLMAP, CRATE, FORMATS
from coupole.exchange.rti import FORMATS as OF_VIEWS

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.exchange.run_colour import ColourWanted


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
        """Raise InputError if one of these options was given; `why` is what they are for."""
        if given := [f"--{name}" for name in names if name in self.options]:
            raise InputError(f"{', '.join(given)}: {'is' if len(given) == 1 else 'are'} {why}")

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


@dataclass(frozen=True)
class Found:
    """What was written."""

    files: int
    bytes: int
    misses_dn: dict[str, float] = field(default_factory=dict)
    """Of views: how far the file is from their own pictures, rms, in steps of 8 bits."""


_OF_FRAMES, _OF_A_RESULT = ("views", "shots"), ("fit", "triangle")
_OF_COLOUR = ("sensor-spectra", "led-spectrum", "for-the-eye", "linear")
_OF_A_CRATE = ("licence", "author", "publisher", "name", "identifier", "in-place")


@flattened
def export(
    source: Annotated[Path, typer.Argument(help="A run's folder, or a result's.", show_default=False)],
    to: ToOption,
    options: ExportOptions,
    out: Annotated[Path | None, typer.Option("--out", help="Folder; SOURCE/export if not given.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite existing files.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a run's proven frames, its views, or a result of reflectance, as other programs read them."""
    from coupole.viewing.terminal import bytes_text, make_console

    folder = source if options.in_place else out or source / "export"
    asked = Asked(source, to, folder, overwrite, options.given())
    console = make_console(quiet=as_json)
    try:
        if options.in_place and out is not None:
            raise InputError("--in-place writes into SOURCE: give it, or --out, not both")
        found = _written(asked, console)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    console.print(f"{found.files} files, {bytes_text(found.bytes)}, in {folder}")
    for view, missed in found.misses_dn.items():
        console.print(f"{view}: its own pictures are missed by {missed:.1f} of 255, rms")
    if as_json:
        told = {"out": str(folder.resolve()), "files": found.files, "bytes": found.bytes}
        print(json.dumps({**told, **({"misses_dn": found.misses_dn} if found.misses_dn else {})}))


def _written(asked: Asked, console: Console) -> Found:
    of_run = (asked.source / "object.h5").exists()
    of_pictures = (asked.source / "normals.npy").exists()
    _refuse_unknown(asked, of_run=of_run, of_pictures=of_pictures)
    if of_run:
        asked.refuse(_OF_FRAMES, "for the frames of a run; this is a result")
    else:
        asked.refuse(_OF_A_RESULT, "for results of reflectance of runs")
    if asked.to != CRATE:
        asked.refuse(_OF_A_CRATE, f"for --to {CRATE}")
    if of_run or of_pictures or asked.to not in FORMATS:
        asked.refuse(_OF_COLOUR, "for frames of a run as dng or tiff")
    if asked.to != "bsdf":
        asked.refuse(("adaptive",), f"for --to bsdf; found --to {asked.to}")
    if asked.to != COLMAP:
        asked.refuse(("refined",), f"for --to {COLMAP}")
        if asked.to not in FORMATS:
            asked.refuse(("calibrations",), f"for {COLMAP}, and for colour of frames")
    _refuse_misplaced(asked)
    if asked.to == CRATE:
        return _export_crate(asked, console)
    if of_run:
        return _export_result(asked, console)
    if of_pictures or asked.to in OF_VIEWS:
        return _export_views(asked, console)
    if asked.to == COLMAP:
        return _export_colmap(asked, console)
    return _export_frames(asked, console)


def _refuse_unknown(asked: Asked, *, of_run: bool, of_pictures: bool) -> None:
    """Raise InputError for a format that there is none of for the source, or an option without a value."""
    if of_run:
        formats, kind = OF_RESULTS_OF_RUNS, "a result"
    elif of_pictures:
        formats, kind = OF_PICTURES, "a result of pictures"
    else:
        formats, kind = OF_RUNS, "a run"
    if asked.to not in formats:
        why = f"; {CRATE} is for runs and their results" if asked.to == CRATE else ""
        raise InputError(f"--to: expected one of {', '.join(formats)} for {kind}; found {asked.to}{why}")
    for name, value in asked.options.items():
        if value == "" or (isinstance(value, list) and "" in value):
            raise InputError(f"--{name}: is empty; give a value, or leave it out")


def _refuse_misplaced(asked: Asked) -> None:
    """Raise InputError for options of another kind of views, or values that they do not have."""
    from coupole.exchange.rti.relight_web import BASES, PLANES

    basis, planes = asked.text("basis"), asked.options.get("planes")
    if asked.to != "relight":
        asked.refuse(("basis", "planes"), f"for --to relight; found --to {asked.to}")
    if basis is not None and basis not in BASES:
        raise InputError(f"--basis: expected one of {', '.join(BASES)}; found {basis}")
    if planes is not None and (planes not in PLANES or basis in ("ptm", "hsh")):
        raise InputError(f"--planes {planes}: expected {' or '.join(map(str, PLANES))}, with bilinear or rbf")
    if asked.to != "iiif":
        asked.refuse(("base-url",), f"for --to iiif; found --to {asked.to}")


def _export_result(asked: Asked, console: Console) -> Found:
    from coupole.exchange.of_results.export_result import export_result

    triangles, most_error = tuple(map(int, asked.texts("triangle"))), asked.options.get("adaptive")
    with console.status(f"writing {asked.to}"):
        paths = export_result(
            asked.source,
            asked.to,
            asked.out,
            fit=asked.text("fit"),
            triangles=triangles,
            most_error=most_error if isinstance(most_error, float) else None,
            overwrite=asked.overwrite,
        )
    return _sizes(paths)


def _export_views(asked: Asked, console: Console) -> Found:
    from coupole.exchange.rti.export_views import HowShown, export_views
    from coupole.viewing.terminal import step_bars

    asked.refuse(("shots",), "for single frames; of views all LEDs are written")
    given = {name.replace("-", "_"): asked.options.get(name) for name in ("basis", "planes", "base-url")}
    how = HowShown(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
    views = asked.texts("views")
    with step_bars(console) as say:
        made = export_views(asked.source, asked.to, asked.out, views, how, overwrite=asked.overwrite, say=say)
    return replace(_sizes(made.paths), misses_dn=made.misses_dn)


def _export_colmap(asked: Asked, console: Console) -> Found:
    from coupole.exchange.colmap import export_colmap

    asked.refuse(_OF_FRAMES, f"for single frames; {COLMAP} has all views")
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


def _export_crate(asked: Asked, console: Console) -> Found:
    from coupole.exchange.research_crate import CrateFacts, write_crate

    asked.refuse((*_OF_FRAMES, *_OF_A_RESULT), f"for parts; {CRATE} has all files")
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


def _export_frames(asked: Asked, console: Console) -> Found:
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
    return Found(found.files, found.bytes)


def _colour_of(asked: Asked) -> ColourWanted | None:
    """Raises InputError for options that do not go together."""
    from coupole.exchange.run_colour import ColourWanted

    eye, sensor = "for-the-eye" in asked.options, asked.path("sensor-spectra")
    if eye and asked.to != "tiff":
        raise InputError(f"--for-the-eye: is for --to tiff; a {asked.to} with --sensor-spectra has its colours")
    if not eye:
        asked.refuse(("linear",), "for --for-the-eye")
        if asked.to == "tiff":
            asked.refuse(("sensor-spectra", "led-spectrum"), "for --for-the-eye, or for --to dng")
    if sensor is None:
        if eye or "led-spectrum" in asked.options or "calibrations" in asked.options:
            raise InputError("--sensor-spectra: expected a table of nm, red, green, blue, from the sensor's maker")
        return None
    return ColourWanted(sensor, asked.path("led-spectrum"), asked.records)


def _with_bars(console: Console, write: Callable[[Callable[[str, int, int], None]], list[Path]]) -> list[Path]:
    from coupole.viewing.terminal import step_bars

    with step_bars(console) as bars:
        return write(bars)


def _sizes(paths: list[Path]) -> Found:
    return Found(len(paths), sum(path.stat().st_size for path in paths))

"""The command `coupole export`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, OverwriteOption, fail
from coupole.commands.export_options import ExportOptions, ToOption
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError
from coupole.exchange.formats import Writer, format_named, refuse_others_options, source_of

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.exchange.run_colour import ColourWanted


@dataclass(frozen=True)
class Asked:
    """The request for an export. Options that were not given are empty."""

    source: Path
    to: str
    out: Path
    overwrite: bool
    options: dict[str, object]
    """Options that were given, by name."""

    def refuse(self, names: tuple[str, ...], why: str) -> None:
        """Raise InputError if one of these options was given; `why` is their purpose."""
        if option_names := [f"--{name}" for name in names if name in self.options]:
            raise InputError(f"{', '.join(option_names)}: {'is' if len(option_names) == 1 else 'are'} {why}")

    def texts(self, name: str) -> list[str]:
        texts = self.options.get(name, [])
        assert isinstance(texts, list)
        return list(map(str, texts))

    def text(self, name: str) -> str | None:
        option = self.options.get(name)
        return None if option is None else str(option)

    def path(self, name: str) -> Path | None:
        option = self.options.get(name)
        return option if isinstance(option, Path) else None

    def number(self, name: str) -> float | None:
        option = self.options.get(name)
        return float(option) if isinstance(option, int | float) else None

    def whole_number(self, name: str) -> int | None:
        option = self.options.get(name)
        return option if isinstance(option, int) else None

    @property
    def records(self) -> tuple[Path, ...]:
        from coupole.calibration.record import records_named

        return records_named([Path(text) for text in self.texts("calibrations")])


@dataclass(frozen=True)
class Found:
    """Files that were written."""

    files: int
    bytes: int
    misses_dn: dict[str, float] = field(default_factory=dict)
    """Difference between each view's file and the view's own pictures, rms, in steps of 8 bits."""


@flatten_options
def export(
    source: Annotated[Path, typer.Argument(help="Folder of a run or of a result.", show_default=False)],
    to: ToOption,
    options: ExportOptions,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files; by default SOURCE/export.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a run's proven frames, its views, or a result of reflectance, as other programs read them."""
    from coupole.storage import so_far
    from coupole.viewing.terminal import bytes_text, make_console

    folder = source if options.in_place else out or source / "export"
    console = make_console(quiet=as_json)
    try:
        if out is None and source.name == so_far.LINK:
            raise InputError(f"{source}: give --out, because this folder is removed when the result is complete")
        if options.in_place and out is not None:
            raise InputError("--in-place writes into SOURCE: give either --in-place or --out")
        with so_far.reading(source) as read:
            summary = _write_export(Asked(read, to, folder, overwrite, options.given_options()), console)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    console.print(f"{summary.files} files, {bytes_text(summary.bytes)}, in {folder}")
    for view, miss_dn in summary.misses_dn.items():
        console.print(f"{view}: rms error against the view's own pictures: {miss_dn:.1f} of 255")
    if as_json:
        document = {"out": str(folder.resolve()), "files": summary.files, "bytes": summary.bytes}
        print(json.dumps({**document, **({"misses_dn": summary.misses_dn} if summary.misses_dn else {})}))


def _write_export(request: Asked, console: Console) -> Found:
    export_format = format_named(request.to, source_of(request.source))
    _refuse_empty(request)
    refuse_others_options(export_format, list(request.options))
    writers = {
        Writer.FRAMES: _export_frames,
        Writer.VIEWS: _export_views,
        Writer.POSES: _export_colmap,
        Writer.RESULT: _export_result,
        Writer.CRATE: _export_crate,
    }
    return writers[export_format.writer](request, console)


def _refuse_empty(request: Asked) -> None:
    """Raise InputError for an option without a value."""
    for name, value in request.options.items():
        if value == "" or (isinstance(value, list) and "" in value):
            raise InputError(f"--{name}: is empty; give a value, or leave it out")


def _refuse_unknown_planes(request: Asked) -> None:
    """Raise InputError for a basis or a number of planes that the format `relight` does not have."""
    from coupole.exchange.rti.relight_web import BASES, PLANES

    basis, planes = request.text("basis"), request.options.get("planes")
    if basis is not None and basis not in BASES:
        raise InputError(f"--basis: expected one of {', '.join(BASES)}; found {basis}")
    if planes is not None and (planes not in PLANES or basis in ("ptm", "hsh")):
        raise InputError(f"--planes {planes}: expected {' or '.join(map(str, PLANES))}, with bilinear or rbf")


def _export_result(request: Asked, console: Console) -> Found:
    from coupole.exchange.of_results.export_result import export_result
    from coupole.exchange.of_results.measured_surface import ExportChoice
    from coupole.viewing.terminal import step_bars

    with step_bars(console) as say:
        choice = ExportChoice(
            tuple(map(int, request.texts("triangle"))),
            request.number("adaptive"),
            request.number("texel-mm"),
            request.whole_number("map-px"),
            request.path("uv"),
            say,
            lambda line: console.print(line, markup=False),
        )
        paths = export_result(
            request.source,
            request.to,
            request.out,
            fit=request.text("fit"),
            options=choice,
            overwrite=request.overwrite,
        )
    return _sizes(paths)


def _export_views(request: Asked, console: Console) -> Found:
    from coupole.exchange.rti.export_views import HowShown, export_views
    from coupole.viewing.terminal import step_bars

    _refuse_unknown_planes(request)
    options = {name.replace("-", "_"): request.options.get(name) for name in ("basis", "planes", "base-url")}
    how = HowShown(**{name: value for name, value in options.items() if value is not None})  # type: ignore[arg-type]
    views = request.texts("views")
    with step_bars(console) as say:
        files = export_views(
            request.source, request.to, request.out, views, how, overwrite=request.overwrite, say=say
        )
    return replace(_sizes(files.paths), misses_dn=files.misses_dn)


def _export_colmap(request: Asked, console: Console) -> Found:
    from coupole.exchange.colmap import export_colmap

    return _sizes(
        _with_bars(
            console,
            lambda say: export_colmap(
                request.source,
                request.out,
                records=request.records,
                refined_folder=request.path("refined"),
                overwrite=request.overwrite,
                say=say,
            ),
        )
    )


def _export_crate(request: Asked, console: Console) -> Found:
    from coupole.exchange.research_crate import CrateFacts, write_crate

    facts = CrateFacts(
        request.text("licence"),
        tuple(request.texts("author")),
        request.text("publisher"),
        request.text("name"),
        request.text("identifier"),
    )
    in_place = "in-place" in request.options
    return _sizes(
        _with_bars(
            console,
            lambda say: write_crate(
                request.source, request.out, facts, in_place=in_place, overwrite=request.overwrite, say=say
            ),
        )
    )


def _export_frames(request: Asked, console: Console) -> Found:
    from rich.progress import Progress

    from coupole.exchange.export import FramePatterns, export_run
    from coupole.storage.run import Run

    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("export")
        files = export_run(
            Run(request.source),
            request.to,
            request.out,
            patterns=FramePatterns(request.texts("views"), request.texts("shots")),
            colour=_colour_of(request),
            overwrite=request.overwrite,
            progress=lambda count, total: bars.update(bar, completed=count, total=total),
        )
    return Found(files.files, files.bytes)


def _colour_of(request: Asked) -> ColourWanted | None:
    """Return the wanted colours. Raises InputError for options that do not go together."""
    from coupole.exchange.run_colour import ColourWanted

    eye, sensor = "for-the-eye" in request.options, request.path("sensor-spectra")
    if eye and request.to != "tiff":
        raise InputError(
            f"--for-the-eye: is for --to tiff; a {request.to} contains colours if --sensor-spectra is given"
        )
    if not eye:
        request.refuse(("linear",), "for --for-the-eye")
        if request.to == "tiff":
            request.refuse(("sensor-spectra", "led-spectrum"), "for --for-the-eye, or for --to dng")
    if sensor is None:
        if eye or "led-spectrum" in request.options or "calibrations" in request.options:
            raise InputError("--sensor-spectra: expected a table of nm, red, green, blue, from the sensor's maker")
        return None
    return ColourWanted(sensor, request.path("led-spectrum"), request.records, "linear" in request.options)


def _with_bars(console: Console, write: Callable[[Callable[[str, int, int], None]], list[Path]]) -> list[Path]:
    from coupole.viewing.terminal import step_bars

    with step_bars(console) as bars:
        return write(bars)


def _sizes(paths: list[Path]) -> Found:
    return Found(len(paths), sum(path.stat().st_size for path in paths))

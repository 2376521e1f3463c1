"""The command `coupole export`: frames, views and results for other programs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError
from coupole.exchange import FORMATS
from coupole.exchange.of_results import FORMATS as OF_RESULTS
from coupole.exchange.rti import FORMATS as OF_VIEWS
from coupole.exchange.rti import OF_RUNS_ONLY

if TYPE_CHECKING:
    from rich.console import Console

_OF_PICTURES = [name for name in OF_VIEWS if name not in OF_RUNS_ONLY]

ToOption = Annotated[
    str,
    typer.Option(
        "--to",
        help=f"Of runs: {', '.join((*FORMATS, *OF_VIEWS))}. Of results: {', '.join(OF_RESULTS)}; "
        f"of results of pictures: {', '.join(_OF_PICTURES)}.",
        show_default=False,
    ),
]
ViewsOption = Annotated[
    list[str] | None, typer.Option("--views", help="Of runs: names, with * and ?; again for more.")
]
ShotsOption = Annotated[
    list[str] | None, typer.Option("--shots", help="Of runs: labels, as `led04*/e0`; again for more.")
]
FitOption = Annotated[
    str | None, typer.Option("--fit", help="Of results: ggx or ggx_normal; without it what missed least.")
]
TriangleOption = Annotated[
    list[int] | None,
    typer.Option("--triangle", help="Of results, for bsdf, merl, alta: its number; again for more.", min=0),
]
BasisOption = Annotated[
    str | None,
    typer.Option("--basis", help="For relight: bilinear (without this option), rbf, ptm or hsh."),
]
PlanesOption = Annotated[
    int | None,
    typer.Option("--planes", help="For relight, bilinear and rbf: 27 (without this option) or 18."),
]
BaseUrlOption = Annotated[
    str | None,
    typer.Option(
        "--base-url",
        help="For iiif: the address where the folder will be found; ids in the files begin with it. Without it "
        "they begin with https://example.org/iiif, and no viewer finds the pictures.",
    ),
]


@dataclass(frozen=True)
class _Request:
    """What is written of a source, and where to."""

    source: Path
    to: str
    folder: Path
    overwrite: bool


def export(
    source: Annotated[Path, typer.Argument(help="A run's folder, or a result's.", show_default=False)],
    to: ToOption,
    views: ViewsOption = None,
    shots: ShotsOption = None,
    fit: FitOption = None,
    triangle: TriangleOption = None,
    basis: BasisOption = None,
    planes: PlanesOption = None,
    base_url: BaseUrlOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder; SOURCE/export if not given.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite existing files.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a run's proven frames or views, or a result of reflectance, as other programs read them."""
    from coupole.viewing.terminal import bytes_text, make_console

    console = make_console(quiet=as_json)
    folder = out or source / "export"
    request = _Request(source, to, folder, overwrite)
    misses_dn: dict[str, float] = {}
    try:
        _refuse_misplaced(to, basis, planes, base_url)
        if (source / "object.h5").exists():
            if views or shots:
                raise InputError("--views, --shots: are for the frames of a run; this is a result")
            files, size = _of_result(request, fit, tuple(triangle or ()), console)
        else:
            if fit is not None or triangle:
                raise InputError("--fit, --triangle: are for results of reflectance of runs")
            if to in OF_VIEWS or (source / "normals.npy").exists():
                if shots:
                    raise InputError("--shots: are for single frames; of views all LEDs are written")
                files, size, misses_dn = _of_views(request, views or [], basis, planes, base_url, console)
            else:
                files, size = _of_frames(request, views or [], shots or [], console)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    console.print(f"{files} files, {bytes_text(size)}, in {folder}")
    for view, missed in misses_dn.items():
        console.print(f"{view}: its own pictures are missed by {missed:.1f} of 255, rms")
    if as_json:
        found = {"out": str(folder.resolve()), "files": files, "bytes": size}
        print(json.dumps({**found, **({"misses_dn": misses_dn} if misses_dn else {})}))


def _refuse_misplaced(to: str, basis: str | None, planes: int | None, base_url: str | None) -> None:
    """Raise InputError for options of another format, or values that they do not have."""
    from coupole.exchange.rti.relight_web import BASES, PLANES

    if to != "relight" and (basis is not None or planes is not None):
        raise InputError(f"--basis, --planes: are for --to relight; found --to {to}")
    if basis is not None and basis not in BASES:
        raise InputError(f"--basis: expected one of {', '.join(BASES)}; found {basis}")
    if planes is not None and (planes not in PLANES or basis in ("ptm", "hsh")):
        raise InputError(f"--planes {planes}: expected {' or '.join(map(str, PLANES))}, with bilinear or rbf")
    if to != "iiif" and base_url is not None:
        raise InputError(f"--base-url: is for --to iiif; found --to {to}")


def _of_result(
    request: _Request, fit: str | None, triangles: tuple[int, ...], console: Console
) -> tuple[int, int]:
    from coupole.exchange.of_results.export_result import export_result

    with console.status(f"writing {request.to}"):
        paths = export_result(
            request.source,
            request.to,
            request.folder,
            fit=fit,
            triangles=triangles,
            overwrite=request.overwrite,
        )
    return len(paths), _bytes(paths)


def _of_views(
    request: _Request,
    views: list[str],
    basis: str | None,
    planes: int | None,
    base_url: str | None,
    console: Console,
) -> tuple[int, int, dict[str, float]]:
    from coupole.exchange.rti.export_views import HowShown, export_views
    from coupole.viewing.terminal import step_bars

    given = {"basis": basis, "planes": planes, "base_url": base_url}
    how = HowShown(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
    with step_bars(console) as say:
        written = export_views(
            request.source, request.to, request.folder, views, how, overwrite=request.overwrite, say=say
        )
    return len(written.paths), _bytes(written.paths), written.misses_dn


def _of_frames(request: _Request, views: list[str], shots: list[str], console: Console) -> tuple[int, int]:
    from rich.progress import Progress

    from coupole.exchange.export import export_run
    from coupole.storage.run import Run

    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("export")
        found = export_run(
            Run(request.source),
            request.to,
            request.folder,
            views=views,
            shots=shots,
            overwrite=request.overwrite,
            progress=lambda done, total: bars.update(bar, completed=done, total=total),
        )
    return found.files, found.bytes


def _bytes(paths: list[Path]) -> int:
    return sum(path.stat().st_size for path in paths)

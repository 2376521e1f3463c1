"""The command `coupole show`: a page that any browser opens from disk, offline."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from coupole.exchange.look.look_blocks import Look

SourceArgument = Annotated[
    Path, typer.Argument(help="Folder of a result of runs or of pictures.", show_default=False)
]
OutOption = Annotated[Path, typer.Option("--out", help="The page, FILE.html.", show_default=False)]


def show(source: SourceArgument, out: OutOption, as_json: JsonOption = False) -> None:
    """Make a page to look at a measured object: turn it, light it anew, measure it, see how well it is known."""
    from coupole.exchange.look.look_page import write_page
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        if not source.is_dir():
            raise InputError(
                f"{source}: expected the folder of a result; `coupole reflectance RUN --out FOLDER` makes one"
            )
        with step_bars(console) as bars:
            bars("read", 0, 2)
            look = _look(source)
            bars("write", 1, 2)
            files = write_page(look, source.resolve().name, out)
            bars("write", 2, 2)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    size_bytes = sum(file.stat().st_size for file in files)
    if as_json:
        said = {"page": str(files[0].resolve()), "files": len(files), "bytes": size_bytes, "about": look.about}
        print(json.dumps(said))
    else:
        console.print(f"{files[0]}: {size_bytes / 1e6:.1f} MB in {len(files)} files; open it in a browser")


def _look(source: Path) -> Look:
    """By what the folder holds. Raises InputError if that is no whole result."""
    from coupole.exchange.look.look_of_pictures import look_of_pictures
    from coupole.exchange.look.look_of_runs import look_of_result
    from coupole.reflectance import picture_result, run_result

    try:
        if (source / picture_result.SAMPLES).exists():
            return look_of_pictures(source)
        if (source / run_result.OBJECT).exists():
            return look_of_result(source)
    except (OSError, KeyError) as error:
        raise InputError(f"{source}: is damaged ({error}); make the result again into another folder") from error
    raise InputError(f"{source}: holds no result; `coupole reflectance {source} --out FOLDER` makes one of a run")

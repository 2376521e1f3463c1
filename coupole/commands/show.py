"""The command `coupole show`: a page that any browser opens from disk, offline."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from coupole.exchange.look.look_blocks import Look

SourceArgument = Annotated[
    Path, typer.Argument(help="Folder of a run, or of a result of runs or of pictures.", show_default=False)
]
ViewOption = Annotated[
    list[str],
    typer.Option("--view", help="Of a run: views to show, NAME or a pattern; repeatable. All without it."),
]
OutOption = Annotated[Path, typer.Option("--out", help="The page, FILE.html.", show_default=False)]


def show(source: SourceArgument, out: OutOption, view: ViewOption = [], as_json: JsonOption = False) -> None:  # noqa: B006
    """Make a page to look at a measured object: turn it, light it anew, measure it, see how well it is known."""
    from coupole.exchange.look.look_page import write_page
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        if not source.is_dir():
            raise InputError(
                f"{source}: is neither run nor result (`coupole reflectance RUN --out FOLDER` makes one)"
            )
        with step_bars(console) as bars:
            bars("read", 0, 1)
            look = _look(source, view, bars)
            bars("write", 0, 1)
            files = write_page(look, source.resolve().name, out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    size_bytes = sum(file.stat().st_size for file in files)
    if as_json:
        said = {"page": str(files[0].resolve()), "files": len(files), "bytes": size_bytes, "about": look.about}
        print(json.dumps(said))
    else:
        console.print(f"{files[0]}: {size_bytes / 1e6:.1f} MB in {len(files)} files; open it in a browser")


def _look(source: Path, views: list[str], say: Callable[[str, int, int], None]) -> Look:
    """By what the folder holds. Raises InputError if that is neither a run nor a whole result."""
    from coupole.exchange.look.look_of_frames import look_of_run
    from coupole.exchange.look.look_of_pictures import look_of_pictures
    from coupole.exchange.look.look_of_runs import look_of_result
    from coupole.reflectance import picture_result, run_result
    from coupole.storage.run_json import RUN_JSON

    try:
        if (source / RUN_JSON).exists():
            return look_of_run(source, views, say)
        if views:
            raise InputError(f"--view: {source} is no run; a result is shown as a whole")
        if (source / picture_result.SAMPLES).exists():
            return look_of_pictures(source)
        if (source / run_result.OBJECT).exists():
            return look_of_result(source)
    except (OSError, KeyError) as error:
        raise InputError(f"{source}: is damaged ({error}); make the result again into another folder") from error
    raise InputError(
        f"{source}: holds no run and no result; `coupole reflectance RUN --out FOLDER` makes one of a run"
    )

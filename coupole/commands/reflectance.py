"""The command `coupole reflectance`: the main job and its steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

JOB = "from"
"""Name of the main job among the steps; nobody types it."""


class JobOrStep(TyperGroup):
    """A first word that is a step's name is the step; anything else belongs to the main job."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [JOB, *args]
        return super().parse_args(ctx, args)


reflectance_app = typer.Typer(
    cls=JobOrStep,
    help="Normals and materials at each pixel from pictures under known lights, and pictures under new lights.\n\n"
    "`coupole reflectance --pictures FOLDER --lights FILE --out OUT` makes a result; "
    "`coupole reflectance from --help` lists its options. A step's name as first word is the step.",
    no_args_is_help=True,
)


@reflectance_app.command(JOB)
def from_pictures(
    pictures: Annotated[
        Path,
        typer.Option(
            "--pictures",
            help="Folder of 8- or 16-bit pictures, linear, in the order of its filenames.txt, else sorted.",
            show_default=False,
        ),
    ],
    lights: Annotated[
        Path,
        typer.Option(
            "--lights",
            help="Directions to the lights, one in each line (x right, y up, z to the camera), or an .lp file.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the result.", show_default=False)],
    intensities: Annotated[
        Path | None,
        typer.Option(
            "--intensities", help="One number or three (r g b) for each light; values are divided by them."
        ),
    ] = None,
    mask: Annotated[
        Path | None, typer.Option("--mask", help="Picture that is black where nothing is fitted.")
    ] = None,
    leave_out: Annotated[
        str,
        typer.Option(
            "--leave-out", help="Lights (from 0) that are kept for the check: 4,12,20.", show_default=False
        ),
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Fit normals and materials to pictures of one view under distant lights, learn to relight them, check it.

    A job that was stopped goes on where it was when it is given again.
    """
    from coupole.reflectance.picture_job import fit_pictures
    from coupole.reflectance.picture_set import read_pictures
    from coupole.viewing import reflectance_page
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        given = read_pictures(pictures, lights, intensities=intensities, mask=mask)
        with step_bars(console) as say:
            about = fit_pictures(given, out, left_out=_numbers(leave_out), say=say)
        page = reflectance_page.write(out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    for remark in reflectance_page.remarks(about):
        console.print(remark)
    console.print(f"report {page}")
    if as_json:
        print(json.dumps({name: value for name, value in about.items() if name != "inputs"}))


def _numbers(text: str) -> list[int]:
    words = [word for word in text.replace(" ", "").split(",") if word]
    try:
        return [int(word) for word in words]
    except ValueError as error:
        raise InputError(f"--leave-out: expected numbers with commas between, got {text!r}") from error


@reflectance_app.command()
def relight(
    result: Annotated[Path, typer.Argument(help="Folder of a result.", show_default=False)],
    direction: Annotated[
        str, typer.Option("--direction", help="To the light: x right, y up, z to the camera.", show_default=False)
    ],
    to: Annotated[
        Path,
        typer.Option(
            "--to", help="picture.npy or .exr: float32, linear; .png: 16 bit, linear.", show_default=False
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Make the picture that a distant light from a new direction would give."""
    from coupole.exchange.picture_files import refuse_unknown, write_picture
    from coupole.reflectance.picture_result import PictureResult
    from coupole.reflectance.relighting import read_interpolation, relit

    try:
        refuse_unknown(to)
        towards = _direction(direction)
        made = PictureResult(result)
        made.about  # noqa: B018  refuses what is no result
        write_picture(to, relit(made, read_interpolation(result), towards))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps({"picture": str(to.resolve())}))


def _direction(text: str) -> NDArray[np.float64]:
    import numpy as np

    try:
        direction = np.array([float(word) for word in text.split(",")])
    except ValueError:
        direction = np.empty(0)
    if direction.shape != (3,) or not np.all(np.isfinite(direction)) or np.linalg.norm(direction) < 1e-9:
        raise InputError(f"--direction: expected X,Y,Z, not all 0; got {text!r}")
    return direction

"""The command `coupole reflectance relight`: pictures of a result under new lights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, ResultArgument, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def relight(
    result: ResultArgument,
    direction: Annotated[
        str,
        typer.Option(
            "--direction",
            help="To the light. Of pictures: x right, y up, z to the camera; of runs: in the support frame, z up.",
            show_default=False,
        ),
    ],
    to: Annotated[
        Path,
        typer.Option(
            "--to", help="picture.npy or .exr: float32, linear; .png: 16 bit, linear.", show_default=False
        ),
    ],
    view: Annotated[str | None, typer.Option("--view", help="Of a result of runs; the first without it.")] = None,
    fit: Annotated[
        str | None,
        typer.Option(
            "--fit",
            help="Of a result of runs: ggx, ggx_normal, sh, rbf, ggx_rbf or clusters; without it the one that "
            "missed least in the check.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make the picture that a distant light from a new direction would give."""
    from coupole.exchange.picture_files import refuse_unknown, write_picture

    try:
        refuse_unknown(to)
        write_picture(to, _relit(result, _direction(direction), view, fit))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps({"picture": str(to.resolve())}))


def _relit(result: Path, towards: NDArray[np.float64], view: str | None, fit: str | None) -> NDArray[np.float32]:
    import numpy as np

    from coupole.reflectance import picture_result, run_result
    from coupole.reflectance.relighting import read_interpolation, relit
    from coupole.reflectance.run_relighting import relit_view

    if (result / run_result.OBJECT).exists():
        run_result.read_about(result)
        picture = relit_view(run_result.RunResult(result), towards, view, fit)
        return picture if picture.shape[2] == 3 else np.repeat(picture, 3, axis=2)
    for option, value in (("--view", view), ("--fit", fit)):
        if value is not None:
            raise InputError(f"{option}: a result of pictures has one view and one way to relight it")
    made = picture_result.PictureResult(result)
    made.about  # noqa: B018  refuses what is no result
    return relit(made, read_interpolation(result), towards)


def _direction(text: str) -> NDArray[np.float64]:
    import numpy as np

    try:
        direction = np.array([float(word) for word in text.split(",")])
    except ValueError:
        direction = np.empty(0)
    if direction.shape != (3,) or not np.all(np.isfinite(direction)) or np.linalg.norm(direction) < 1e-9:
        raise InputError(f"--direction: expected X,Y,Z, not all 0; got {text!r}")
    return direction

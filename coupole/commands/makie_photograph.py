"""`coupole makie`: a photograph of metal powder on lacquer, taken apart into a drawing for scenes."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from coupole.appearance.matter.makie import Makie

_AROUND_PX = 4
"""A colour is the mean of the pixels up to this far from the place that is named."""
_TOLD_FROM = 0.01
"""Share of clamped pixels from which it is told."""


def makie(
    photograph: Annotated[
        Path, typer.Argument(help="PNG, TIFF or JPEG of 8 or 16 bits, in sRGB.", show_default=False)
    ],
    metal: Annotated[
        str,
        typer.Option("--metal", metavar="X,Y", help="A pixel in the middle of bare metal.", show_default=False),
    ],
    lacquer: Annotated[
        list[str],
        typer.Option(
            "--lacquer",
            metavar="X,Y",
            help="A pixel in the middle of bare lacquer; repeat for more colours (up to three).",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="The drawing: PNG with alpha.", show_default=False)],
    linear: Annotated[
        bool, typer.Option("--linear", help="Pixel values are proportional to light, without sRGB's curve.")
    ] = False,
    inside: Annotated[
        bool,
        typer.Option("--inside", help="Pixels hold metal and lacquer only, no shadow: exact for three colours."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Take a photograph of makie apart: alpha is the share of metal, colours are the lacquers' part.

    Take it in diffuse light, so that all of the metal shines alike. X counts columns from the left, Y rows from
    the top, both from 0.
    """
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        from coupole.appearance.matter.makie import decompose

        if out.suffix.lower() != ".png":
            raise InputError(f"--out {out}: expected a name that ends in .png")
        picture = _linear_values(photograph, linear=linear)
        colour = _colour_at(picture, metal, "--metal")
        bare = [_colour_at(picture, place, "--lacquer") for place in lacquer]
        parts = decompose(picture, colour, bare, region="inside" if inside else "anywhere")
        _write(out, parts)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        lacquers = [rgb.tolist() for rgb in bare]
        document = {"drawing": str(out), "metal": colour.tolist(), "lacquers": lacquers}
        print(json.dumps(document | {"clamped": parts.clamped_share}))
        return
    console.print(f"{out}: {float(parts.alpha.mean()):.1%} of the picture is metal", markup=False)
    if parts.clamped_share > _TOLD_FROM:
        console.print(
            f"of {parts.clamped_share:.1%} of the pixels the share of metal was beyond 0 or 1 and was cut off: "
            "noise, shadow, or a colour that --metal or --lacquer do not name",
            markup=False,
        )


def _linear_values(path: Path, *, linear: bool) -> NDArray[np.float64]:
    """[h, w, 3] proportional to light, 0 to 1."""
    import numpy as np

    from coupole.reflectance.picture_set import linear_of_srgb, read_picture

    pixels = read_picture(path)
    values = pixels if linear else linear_of_srgb(pixels)
    return np.asarray(values / float(np.iinfo(values.dtype).max))


def _colour_at(picture: NDArray[np.float64], place: str, option: str) -> NDArray[np.float64]:
    """[3] mean about a place X,Y."""
    import numpy as np

    height, width = picture.shape[:2]
    words = place.split(",")
    numbers = [int(word) for word in words if word.strip().isascii() and word.strip().isdigit()]
    if len(words) != 2 or len(numbers) != 2 or numbers[0] >= width or numbers[1] >= height:
        raise InputError(f"{option} {place}: expected X,Y of a pixel of a picture of {width} x {height}, from 0")
    columns, rows = (slice(max(0, number - _AROUND_PX), number + _AROUND_PX + 1) for number in numbers)
    return np.asarray(picture[rows, columns].mean(axis=(0, 1)))


def _write(path: Path, makie: Makie) -> None:
    import numpy as np
    from PIL import Image

    from coupole.exchange.srgb import srgb
    from coupole.storage.durable import write_synced

    channels: Any = np.concatenate([srgb(makie.residual), makie.alpha[..., None]], axis=2)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255.0 * channels).astype(np.uint8)).save(buffer, "PNG")
    write_synced(path, buffer.getvalue())

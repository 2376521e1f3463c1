"""`coupole makie`: separates a photograph of metal powder on lacquer into a drawing for scenes."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
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
"""Half width, px, of the square over which a colour is averaged; the named pixel is its centre."""
_TOLD_FROM = 0.01
"""Share of clamped pixels above which a message states it."""


@dataclass(frozen=True)
class _Result:
    """The parts of a separated photograph."""

    parts: Makie
    metal_rgb: NDArray[np.float64]
    """[3] colour of the metal, linear, in the photograph's unit."""
    lacquer_rgbs: list[NDArray[np.float64]]
    """List of [3], in the unit of `metal_rgb`."""
    unknown_share: float
    """Share of pixels that are saturated or dark in a merged photograph."""
    checks: list[dict[str, Any]]
    """Shares found at the places whose share is known."""


def makie(
    photograph: Annotated[
        Path,
        typer.Argument(
            help="PNG, TIFF or JPEG in sRGB, a raw file, or an .exr of `coupole bracket`.", show_default=False
        ),
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
        typer.Option("--inside", help="Assume only metal and lacquer, without shadow; exact for three colours."),
    ] = False,
    known_shares: Annotated[
        list[str] | None,
        typer.Option(
            "--known",
            metavar="X,Y,SHARE",
            help="A place whose share of metal is known, to check the result; repeat for more.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Separate a photograph of makie: alpha is the share of metal, and the colours are the lacquers' colours.

    Photograph in diffuse light, so that all of the metal is equally bright. X counts columns from the left, Y rows
    from the top, both from 0.
    """
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if out.suffix.lower() != ".png":
            raise InputError(f"--out {out}: expected a name that ends in .png")
        picture = _linear_values(photograph, linear=linear)
        result = _take_apart(picture, metal, lacquer, known_shares or [], is_inside=inside)
        _write(out, result)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(_document(out, result)))
        return
    _say(console, out, result)


def _take_apart(
    picture: NDArray[np.float64], metal: str, lacquers: list[str], known_shares: list[str], *, is_inside: bool
) -> _Result:
    """Separate a linear picture [h, w, 3], NaN where a pixel is not known. Places are texts of the options."""
    import numpy as np

    from coupole.appearance.matter.makie import decompose

    metal_rgb = _colour_at(picture, metal, "--metal")
    lacquer_rgbs = [_colour_at(picture, place, "--lacquer") for place in lacquers]
    is_unknown = np.asarray(~np.isfinite(picture).all(axis=2))
    picture = np.where(is_unknown[..., None], 0.0, picture)
    parts = decompose(picture, metal_rgb, lacquer_rgbs, region="inside" if is_inside else "anywhere")
    checks = [_check_share(parts.alpha, is_unknown, place) for place in known_shares]
    return _Result(parts, metal_rgb, lacquer_rgbs, float(is_unknown.mean()), checks)


def _document(out: Path, result: _Result) -> dict[str, Any]:
    return {
        "drawing": str(out),
        "metal": result.metal_rgb.tolist(),
        "lacquers": [rgb.tolist() for rgb in result.lacquer_rgbs],
        "clamped": result.parts.clamped_share,
        "unknown": result.unknown_share,
        "known": result.checks,
    }


def _say(console: Any, out: Path, result: _Result) -> None:
    parts = result.parts
    console.print(f"{out}: {float(parts.alpha.mean()):.1%} of the picture is metal", markup=False)
    for check in result.checks:
        shares = f"share {check['found']:.3f} +- {check['u_found']:.3f}, known {check['share']:g}"
        difference = check["found"] - check["share"]
        console.print(f"at {check['x']},{check['y']}: {shares}, off by {difference:+.3f}", markup=False)
    if result.unknown_share:
        console.print(
            f"{result.unknown_share:.2%} of the pixels are saturated or dark; they count as without metal"
        )
    if parts.clamped_share > _TOLD_FROM:
        console.print(
            f"in {parts.clamped_share:.1%} of the pixels the share of metal was beyond 0 or 1 and was cut off: "
            "noise, shadow, or a colour that neither --metal nor --lacquer names",
            markup=False,
        )


def _linear_values(path: Path, *, linear: bool) -> NDArray[np.float64]:
    """Return values [h, w, 3] proportional to light. They range from 0 to 1; a merged bracket has its own unit,
    and NaN where a pixel is not known."""
    import numpy as np

    if path.suffix.lower() == ".exr":
        from coupole.exchange.bracket.merged_files import read_known

        return read_known(path).astype(float)
    from coupole.exchange.bracket.photographs import PLAIN, read_photograph

    if path.suffix.lower() not in PLAIN:
        return read_photograph(path)[0].astype(float)
    from coupole.reflectance.picture_set import linear_of_srgb, read_picture

    pixels = read_picture(path)
    values = pixels if linear else linear_of_srgb(pixels)
    return np.asarray(values / float(np.iinfo(values.dtype).max))


def _colour_at(picture: NDArray[np.float64], place: str, option: str) -> NDArray[np.float64]:
    """Return [3] the mean around a place X,Y."""
    import numpy as np

    return np.asarray(_about(picture, place.split(","), f"{option} {place}", "X,Y").mean(axis=(0, 1)))


def _check_share(alpha: NDArray[np.float64], is_unknown: NDArray[np.bool_], known_share: str) -> dict[str, Any]:
    """Return the found share at a place X,Y,SHARE: the mean around it, with its standard uncertainty by the
    scatter."""
    import numpy as np

    *place, word = known_share.split(",")
    try:
        share = float(word)
    except ValueError:
        share = -1.0
    if not 0.0 <= share <= 1.0:
        raise InputError(f"--known {known_share}: expected X,Y,SHARE, with a share of metal from 0 to 1")
    alpha_or_nan = np.where(is_unknown, np.nan, alpha)[..., None]
    values = _about(alpha_or_nan, place, f"--known {known_share}", "X,Y,SHARE")
    u_found = float(values.std() / np.sqrt(values.size))
    return {
        "x": int(place[0]),
        "y": int(place[1]),
        "share": share,
        "found": float(values.mean()),
        "u_found": u_found,
    }


def _about(picture: NDArray[np.float64], place: list[str], option: str, form: str) -> NDArray[np.float64]:
    """Return the pixels around a place. Raises InputError for a place outside the picture, or with pixels that are
    not known."""
    import numpy as np

    height, width = picture.shape[:2]
    numbers = [int(word) for word in place if word.strip().isascii() and word.strip().isdigit()]
    if len(place) != 2 or len(numbers) != 2 or numbers[0] >= width or numbers[1] >= height:
        raise InputError(
            f"{option}: expected {form}, with column and row (from 0) of a pixel in the picture of {width} x "
            f"{height}"
        )
    columns, rows = (slice(max(0, number - _AROUND_PX), number + _AROUND_PX + 1) for number in numbers)
    pixels = picture[rows, columns]
    if not np.isfinite(pixels).all():
        raise InputError(
            f"{option}: is saturated or dark in the merged photograph; expected a place that is neither"
        )
    return pixels


def _write(path: Path, result: _Result) -> None:
    """Write the drawing. White is 1, or the brightest value of the named colours if that is above 1."""
    import numpy as np
    from PIL import Image

    from coupole.exchange.srgb import srgb
    from coupole.storage.durable import write_synced

    unit = max(1.0, *(float(rgb.max()) for rgb in (result.metal_rgb, *result.lacquer_rgbs)))
    parts = result.parts
    channels: Any = np.concatenate([srgb(parts.residual / unit), parts.alpha[..., None]], axis=2)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255.0 * channels).astype(np.uint8)).save(buffer, "PNG")
    write_synced(path, buffer.getvalue())

"""The command `coupole reflectance relight`: pictures and videos of a result under new lights."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, ResultArgument, fail
from coupole.commands.completion import fits
from coupole.commands.option_groups import flatten_options
from coupole.commands.relight_for_the_eye import PEAK_QUANTILE, EyeColours, bright, write_relit_for_the_eye
from coupole.errors import CoupoleError, InputError, StorageError, reason
from coupole.reflectance.fits import MATERIALS, RELIT, TEXELS
from coupole.scripting.relit_result import Relit, open_result

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from coupole.reflectance.new_light.light_kinds import AnyLight
    from coupole.reflectance.new_light.pictured_surface import FreeCamera

_LOOKED_AT = 8
"""Number of pictures of a video from which its white is found."""


Several = list[str] | None


def _option(name: str, help_text: str, **limits: Any) -> Any:
    return typer.Option(name, help=help_text, show_default=False, **limits)


ToOption = Annotated[
    Path,
    _option(
        "--to",
        "picture.npy or .exr: float32, linear; .png: 16 bit, linear; with --turn video.mp4: sRGB; with "
        "--for-the-eye .png (8 bit) or .tiff (16 bit): sRGB.",
    ),
]
DirectionOption = Annotated[
    Several,
    _option(
        "--direction",
        "To the light. For pictures: x right, y up, z to the camera; for runs: in the support frame, z up.",
    ),
]
LedOption = Annotated[
    list[int] | None, _option("--led", "An LED of the run; values are shares of the camera's range.", min=0)
]
LightAtOption = Annotated[
    Several, _option("--light-at", "X,Y,Z of a point light, mm; a white diffuser at 1 m from it has the value 1.")
]
AreaOption = Annotated[
    Several,
    _option(
        "--area",
        "X,Y,Z,NX,NY,NZ,WIDTH[,HEIGHT]: centre, normal and sides of a soft light, mm; its radiance is 1.",
    ),
]
EnvironmentOption = Annotated[
    list[Path] | None,
    _option(
        "--environment",
        "Light from everywhere: .exr or .hdr, latitude and longitude. The map's top is z for runs, y for "
        "pictures; its middle is x for runs, z for pictures.",
    ),
]
LightsOption = Annotated[Path | None, _option("--lights", "A file (YAML) of lights with strengths.")]
SamplesOption = Annotated[
    int, typer.Option("--samples", min=1, max=65536, help="Number of samples of each area light and environment.")
]
ViewOption = Annotated[str | None, typer.Option("--view", help="View of a result of runs; by default the first.")]
FromOption = Annotated[str | None, _option("--from", "Place X,Y,Z of a camera, mm, instead of --view.")]
LookAtOption = Annotated[
    str | None, _option("--look-at", "Place X,Y,Z that the camera of --from looks at; by default the object.")
]
SizeOption = Annotated[
    str | None, _option("--size", "Size of the picture of --from, WIDTHxHEIGHT; by default 1024x768.")
]
FieldOption = Annotated[
    float | None,
    _option(
        "--field-of-view",
        "Width of the field of --from, degrees; by default just wide enough for the object.",
        min=0.01,
        max=170.0,
    ),
]
FitOption = Annotated[
    str | None,
    typer.Option(
        "--fit",
        autocompletion=fits,
        help=f"Fit of a result of runs: {', '.join(RELIT[:-1])} or {RELIT[-1]}; by default the fit with the "
        f"smallest error in the check. --uncertainty and --interval are for {', '.join(MATERIALS)} and {TEXELS}, "
        "and then one of these is the default.",
    ),
]
UncertaintyOption = Annotated[
    Path | None,
    _option(
        "--uncertainty",
        "Write the picture's standard uncertainty (68 %) too; .npy, .exr or .png, as --to.",
    ),
]
IntervalOption = Annotated[
    str | None,
    _option(
        "--interval",
        "LOW,HIGH: two files, .npy or .exr, of the bounds of each pixel's 95 % interval, in the unit of --to.",
    ),
]
TurnOption = Annotated[
    int | None, _option("--turn", "Frames of a video in which the lights turn once about z.", min=2, max=100_000)
]
WhiteOption = Annotated[
    float | None,
    _option(
        "--white",
        "Value that a video or a picture for the eye shows as white; by default the 99.9 % quantile of its "
        "values.",
        min=1e-9,
    ),
]


@dataclass(frozen=True)
class Lighting:
    """Options of the lights, and the number of rays to each light with a size. The pictures under all lights are
    summed.
    """

    direction: DirectionOption = None
    led: LedOption = None
    light_at: LightAtOption = None
    area: AreaOption = None
    environment: EnvironmentOption = None
    lights: LightsOption = None
    samples: SamplesOption = 256

    def read_lights(self) -> list[AnyLight]:
        """Return the lights. Raises InputError for an invalid light, and if there is none."""
        from coupole.reflectance.new_light import light_kinds as kinds

        lights: list[AnyLight] = [] if self.lights is None else kinds.read_lights(self.lights)
        lights += [
            kinds.DistantLight(towards=kinds.way_of(option, "--direction")) for option in self.direction or []
        ]
        lights += [kinds.LedLight(number=option) for option in self.led or []]
        lights += [kinds.PointLight(at_mm=kinds.place_of(option, "--light-at")) for option in self.light_at or []]
        lights += [kinds.area_of(option) for option in self.area or []]
        lights += [kinds.EnvironmentLight(file=option) for option in self.environment or []]
        if not lights:
            raise InputError(
                "expected a light: --direction, --led, --light-at, --area, --environment, or --lights with a file"
            )
        return lights


@dataclass(frozen=True)
class Viewpoint:
    """Place from which a result is seen, and the fit that is used."""

    view: ViewOption = None
    from_: FromOption = None
    look_at: LookAtOption = None
    size: SizeOption = None
    field_of_view: FieldOption = None
    fit: FitOption = None


@dataclass(frozen=True)
class MoreOutput:
    """Options of other files that are written, and of the white of pictures."""

    uncertainty: UncertaintyOption = None
    interval: IntervalOption = None
    turn: TurnOption = None
    white: WhiteOption = None


@flatten_options
def relight(
    result: ResultArgument,
    to: ToOption,
    lighting: Lighting,
    viewpoint: Viewpoint,
    more: MoreOutput,
    colours: EyeColours,
    as_json: JsonOption = False,
) -> None:
    """Make the picture that lights which were not there would give. Lights that are named together are summed."""
    from coupole.storage import so_far
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        _refuse_target(to, more, for_the_eye=colours.for_the_eye)
        colour, lights = colours.read_colour(), lighting.read_lights()
        camera = _camera(viewpoint)
        with so_far.reading(result) as folder, step_bars(console) as bars:
            bars("read", 0, 1)
            uncertain = more.uncertainty is not None or more.interval is not None
            relit = open_result(
                folder, viewpoint.view, viewpoint.fit, camera, lighting.samples, uncertain=uncertain
            )
            companions = _companions(relit, lights, more, bars)
            if colour is not None:
                document = write_relit_for_the_eye(relit, lights, to, colour, more.white, bars, companions.clear)
            else:
                document = _write(relit, lights, to, more.turn, more.white, bars, companions.clear)
            companions.write()
            document |= companions.document
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if "white" in document:
        console.print(f"white is {document['white']:.4g}")
    if as_json:
        print(json.dumps(document))
    elif growing := so_far.words(document):
        console.print(growing, markup=False)


def _refuse_target(to: Path, more: MoreOutput, *, for_the_eye: bool) -> None:
    from coupole.exchange import picture_files, picture_for_the_eye, video_files

    files = [to, *([] if more.uncertainty is None else [more.uncertainty])]
    if more.interval is not None:
        files += _low_and_high(more.interval)
        if more.turn is not None:
            raise InputError("--interval: belongs to a picture, not to a video (--turn)")
    if len({file.resolve() for file in files}) < len(files):
        raise InputError("--to, --uncertainty, --interval: expected different files; one is named twice")
    if more.uncertainty is not None:
        picture_files.refuse_unknown(more.uncertainty)
        if more.turn is not None:
            raise InputError("--uncertainty: belongs to a picture, not to a video (--turn)")
    if for_the_eye:
        picture_for_the_eye.refuse_unknown(to)
        if more.turn is not None:
            raise InputError("--for-the-eye: belongs to a picture, not to a video (--turn)")
    elif more.turn is None:
        picture_files.refuse_unknown(to)
        if more.white is not None:
            raise InputError(
                "--white: belongs to a video (--turn) or to --for-the-eye; other pictures hold all values"
            )
    else:
        video_files.refuse_unknown(to)


def _low_and_high(option: str) -> tuple[Path, Path]:
    """Return the two paths of `--interval`. Raises InputError unless they are two files of a format that holds all
    values."""
    names = option.split(",")
    paths = [Path(name) for name in names]
    if len(names) != 2 or any(path.suffix.lower() not in (".npy", ".exr") for path in paths):
        raise InputError(f"--interval: expected LOW,HIGH, two files .npy or .exr; got {option!r}")
    if paths[0].resolve() == paths[1].resolve():
        raise InputError(f"--interval: expected two files; got {names[0]} twice")
    return paths[0], paths[1]


def _camera(viewpoint: Viewpoint) -> FreeCamera | None:
    import numpy as np

    from coupole.reflectance.new_light.light_kinds import place_of
    from coupole.reflectance.new_light.pictured_surface import FreeCamera

    of_it = (
        ("--look-at", viewpoint.look_at),
        ("--size", viewpoint.size),
        ("--field-of-view", viewpoint.field_of_view),
    )
    if viewpoint.from_ is None:
        for option, value in of_it:
            if value is not None:
                raise InputError(f"{option}: belongs to a camera anywhere; give its place with --from")
        return None
    aim = None if viewpoint.look_at is None else np.array(place_of(viewpoint.look_at, "--look-at"))
    place = np.array(place_of(viewpoint.from_, "--from"))
    return FreeCamera(place, aim, _size_px(viewpoint.size or "1024x768"), viewpoint.field_of_view)


def _size_px(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise InputError(f"--size: expected WIDTHxHEIGHT, got {text!r}")
    if not (2 <= int(width) <= 32768 and 2 <= int(height) <= 32768):
        raise InputError(f"--size: expected 2 to 32768 pixels each way, got {text!r}")
    return int(width), int(height)


def _write(
    relit: Relit,
    lights: Sequence[AnyLight],
    to: Path,
    turn: int | None,
    white: float | None,
    bars: Callable[[str, int, int], None],
    before_writing: Callable[[], None],
) -> dict[str, Any]:
    """Make and write the picture or the video; return the content of `--json`."""
    if turn is None:
        from coupole.exchange.picture_files import write_picture

        picture = relit.picture(lights, lambda count, of: bars("light", count, of))
        before_writing()
        write_picture(to, picture)
        return {"picture": str(to.resolve()), **relit.about}
    import numpy as np

    from coupole.exchange.video_files import write_video
    from coupole.reflectance.new_light.light_kinds import turn_light

    def frame(number: int) -> NDArray[np.float32]:
        angle_deg = 360.0 * number / turn
        return relit.picture([turn_light(light, angle_deg) for light in lights], lambda count, of: None)

    if white is None:
        numbers = sorted({number * turn // _LOOKED_AT for number in range(_LOOKED_AT)})
        peaks = []
        for count, number in enumerate(numbers):
            peaks.append(np.quantile(bright(frame(number)), PEAK_QUANTILE))
            bars("exposure", count + 1, len(numbers))
        white = float(np.mean(peaks)) or 1.0

    def frames() -> Iterator[NDArray[np.float32]]:
        for number in range(turn):
            yield frame(number)
            bars("frames", number + 1, turn)

    origin = "of a simulated object" if relit.about.get("simulated") else "of a measured object"
    write_video(
        to, frames(), white=white, about=f"computed by coupole reflectance relight, {origin}; white {white:.4g}"
    )
    return {"video": str(to.resolve()), "frames": turn, "white": white, **relit.about}


@dataclass(frozen=True)
class Companions:
    """Pictures that belong to the picture of `--to`, such as its uncertainty.

    Old companions are removed before the picture is written, and new ones are written after it. So an
    interrupted call never leaves a picture beside the uncertainty of another one.
    """

    pictures: dict[Path, NDArray[np.float32]]
    document: dict[str, Any]
    """Entries of these pictures in `--json`."""

    def clear(self) -> None:
        """Remove old files of their names. Raises StorageError."""
        for path in self.pictures:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise StorageError(f"{path}: {reason(error)}") from error

    def write(self) -> None:
        """Write the pictures. Raises StorageError."""
        from coupole.exchange.picture_files import write_picture

        for path, picture in self.pictures.items():
            write_picture(path, picture)


def _companions(
    relit: Relit, lights: Sequence[AnyLight], more: MoreOutput, bars: Callable[[str, int, int], None]
) -> Companions:
    """Compute the requested companions: the picture's uncertainty, and the bounds of its 95 % interval, which are
    not below 0."""
    import numpy as np

    companions = Companions({}, {})
    if more.uncertainty is not None:
        assert relit.uncertainty is not None
        u = relit.uncertainty(lights, lambda count, of: bars("uncertainty", count, of))
        companions.pictures[more.uncertainty] = u
        companions.document["uncertainty"] = str(more.uncertainty.resolve())
    if more.interval is not None:
        assert relit.half_width_95 is not None
        low, high = _low_and_high(more.interval)
        picture = relit.picture(lights, lambda count, of: bars("light", count, of))
        half_width = relit.half_width_95(lights, lambda count, of: bars("interval", count, of))
        companions.pictures[low] = np.maximum(picture - half_width, np.float32(0.0))
        companions.pictures[high] = picture + half_width
        companions.document["interval"] = [str(path.resolve()) for path in (low, high)]
    return companions

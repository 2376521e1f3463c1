"""`coupole calibrate colour`: colour profile from a chart, and figures of image quality."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.calibration.colour.acceptance import COLOUR
from coupole.commands.calibrate_light import (
    TargetCalibrations,
    frames_with_poses,
    lit_cell_of,
)
from coupole.commands.calibrating import Work, bar, calibration, rig_of
from coupole.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.light.records import Progress
    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.calibration.rotations import Floats

Pictured = Annotated[
    list[Path],
    typer.Argument(
        help="Runs; or pictures of the chart with linear values (TIFF, PNG, OpenEXR, RAW), or one folder of them.",
        show_default=False,
        metavar="RUN_OR_PICTURE...",
    ),
]
ChartOption = Annotated[
    Path,
    typer.Option(
        "--chart",
        help="The chart's description (YAML). For pictures the chart's values are enough (CxF, CGATS, CSV), with "
        "patches A1, A2, ..., B1, ..., a letter for each row.",
        show_default=False,
    ),
]
CornersOption = Annotated[
    str | None,
    typer.Option(
        "--corners",
        metavar='"X,Y X,Y X,Y X,Y"',
        help="Centres of the chart's top left, top right, bottom right and bottom left patch, px. For runs: in "
        "the first view's frames; by default the chart lies as its description says. For pictures: begin at any "
        "corner and go round; by default the chart is searched for.",
        show_default=False,
    ),
]
WhiteOption = Annotated[
    Path | None,
    typer.Option(
        "--white",
        help=(
            "For runs: a run of the same plan with a white sheet where the chart lay; it replaces the LEDs' "
            "known light. For pictures: a picture of a white card where the chart lay; it replaces the light "
            "found from the patches."
        ),
        show_default=False,
    ),
]
WithoutOption = Annotated[
    str | None, typer.Option("--without", help="Names of patches to leave out, such as A1,B2.", show_default=False)
]
SrgbOption = Annotated[
    bool,
    typer.Option(
        "--srgb",
        help="The pictures have the transfer curve of sRGB and no other curve; by default they are linear.",
    ),
]


@calibration("colour", limits=COLOUR, valid_days=365)
def colour(
    runs: Pictured,
    chart: ChartOption,
    corners: CornersOption = None,
    white: WhiteOption = None,
    without: WithoutOption = None,
    srgb: SrgbOption = False,
    *,
    known: TargetCalibrations,
) -> Work:
    """Colour profile of a camera, as record and as ICC file, from a chart in runs of the dome, or in plain
    pictures of any camera under any light.

    States CIEDE2000 of patches left out, tone, noise, sharpness and registration of colours.
    """
    options = _GivenOptions(chart, corners, white, without, known)
    if any((path / "run.json").is_file() for path in runs):
        if srgb:
            raise InputError("--srgb: belongs to pictures; a run's frames are linear")
        return _by_runs(runs, options)
    return _by_pictures(runs, options, srgb=srgb)


@dataclass(frozen=True)
class _GivenOptions:
    """Options of the command, as given."""

    chart: Path
    corners: str | None
    white: Path | None
    without: str | None
    calibrations: TargetCalibrations

    @property
    def names_without(self) -> list[str]:
        return [name.strip() for name in (self.without or "").split(",") if name.strip()]


def _by_runs(runs: list[Path], options: _GivenOptions) -> Work:
    from coupole.calibration.colour.chart import read_chart
    from coupole.calibration.colour.chart_views import ChartSetting
    from coupole.calibration.colour.colour_workflow import Origin, colour_outcome, see_in_runs
    from coupole.calibration.light.frames import open_light_frames
    from coupole.plan.cell import read_cell

    calibrations, white = options.calibrations, options.white

    def work(console: Console, request: Request) -> Outcome:
        patches = read_chart(options.chart, options.names_without)
        frames = frames_with_poses(open_light_frames(runs), calibrations.hand_eye, calibrations.rig, runs)
        whites = (
            None
            if white is None
            else frames_with_poses(open_light_frames([white]), calibrations.hand_eye, calibrations.rig, runs)
        )
        rig_path = calibrations.rig or rig_of(runs[0])
        cell = read_cell(rig_path)
        lit_cell = lit_cell_of(frames, cell, calibrations, (*patches.files, rig_path))
        setting = ChartSetting(**vars(lit_cell), chart=patches.chart, corners_px=corners_of(options.corners))
        with bar(console, "frames of the chart") as progress:
            sightings = see_in_runs(frames, setting, whites, progress)
        with bar(console, "patches left out") as progress:
            origin = Origin(frames, frames.size_px, setting.inputs)
            return colour_outcome(sightings, patches, origin, request, progress)

    return work


def _by_pictures(paths: list[Path], options: _GivenOptions, *, srgb: bool) -> Work:
    from coupole.scripting.colour_profiles import ChartInputs, profile_of

    def work(console: Console, request: Request) -> Outcome:
        _refuse_options_of_runs(options)
        corners_px = corners_of(options.corners)
        inputs = ChartInputs(paths, options.chart, options.white, corners_px, options.names_without, srgb)
        return profile_of(inputs, request, _At(console))

    return work


@dataclass(frozen=True)
class _At:
    """Shows the progress of the work at the terminal."""

    console: Console

    def status(self, words: str) -> AbstractContextManager[object]:
        return self.console.status(words)

    def bar(self, words: str) -> AbstractContextManager[Progress]:
        return bar(self.console, words)


def _refuse_options_of_runs(options: _GivenOptions) -> None:
    """Raise InputError for options that describe the dome."""
    usual = TargetCalibrations()
    flags = {field.name: f"--{field.name.removesuffix('_record').replace('_', '-')}" for field in fields(usual)}
    wrong_flags = [
        flag for name, flag in flags.items() if getattr(options.calibrations, name) != getattr(usual, name)
    ]
    if wrong_flags:
        raise InputError(f"{', '.join(wrong_flags)}: belongs to a run of the dome; these are pictures")


def corners_of(words: str | None) -> Floats | None:
    """Return [4, 2] px of the text `X,Y X,Y X,Y X,Y`. Raises InputError for any other text."""
    import numpy as np

    if words is None:
        return None
    try:
        corners_px = np.array([[float(number) for number in pair.split(",")] for pair in words.split()])
    except ValueError:
        corners_px = np.empty(0)
    if corners_px.shape != (4, 2) or not np.isfinite(corners_px).all():
        raise InputError(f'--corners: expected four pairs of pixels "X,Y X,Y X,Y X,Y", found {words!r}')
    return corners_px

"""`coupole calibrate colour`: colour profile from a chart, and figures of image quality."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.calibration.colour.acceptance import COLOUR
from coupole.commands.calibrate_light import (
    Runs,
    TargetCalibrations,
    frames_with_poses,
    lens_of,
)
from coupole.commands.calibrating import Work, bar, calibration, emission_of, rig_of
from coupole.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.calibration.rotations import Floats

ChartOption = Annotated[Path, typer.Option("--chart", help="The chart's description (YAML).", show_default=False)]
CornersOption = Annotated[
    str | None,
    typer.Option(
        "--corners",
        metavar='"X,Y X,Y X,Y X,Y"',
        help="Centres of the chart's top left, top right, bottom right and bottom left patch in the"
        " first view's frames, px; by default the chart lies as its description says.",
        show_default=False,
    ),
]
WhiteOption = Annotated[
    Path | None,
    typer.Option(
        "--white",
        help="A run of the same plan with a white sheet in the chart's place; it replaces the LEDs' known light.",
        show_default=False,
    ),
]
WithoutOption = Annotated[
    str | None, typer.Option("--without", help="Names of patches to leave out, as A1,B2.", show_default=False)
]


@calibration("colour", limits=COLOUR, valid_days=365)
def colour(
    runs: Runs,
    chart: ChartOption,
    corners: CornersOption = None,
    white: WhiteOption = None,
    without: WithoutOption = None,
    *,
    known: TargetCalibrations,
) -> Work:
    """Colour profile of the camera under the LEDs, as record and as ICC file, from views of a chart of patches.

    States CIEDE2000 of patches left out, tone, noise, sharpness and registration of colours.
    """
    from coupole.calibration.colour.chart import read_chart
    from coupole.calibration.colour.chart_views import ChartSetting
    from coupole.calibration.colour.colour_workflow import colour_outcome, see_in_runs
    from coupole.calibration.light.frames import open_light_frames
    from coupole.calibration.light.led_power_tile import calibrated_positions
    from coupole.calibration.light.tile_views import Positions
    from coupole.plan.cell import read_cell

    def work(console: Console, request: Request) -> Outcome:
        patches = read_chart(chart, [name.strip() for name in (without or "").split(",") if name.strip()])
        frames = frames_with_poses(open_light_frames(runs), known.hand_eye, known.rig, runs)
        whites = (
            None
            if white is None
            else frames_with_poses(open_light_frames([white]), known.hand_eye, known.rig, runs)
        )
        rig_path = known.rig or rig_of(runs[0])
        cell = read_cell(rig_path)
        by_table = Positions(cell.leds.ids, cell.leds.positions_mm, cell.leds.normals)
        files = (*patches.files, rig_path, known.leds or cell.leds_path, known.hand_eye, known.camera)
        setting = ChartSetting(
            patches.chart,
            cell.rig.support.base_from_support.matrix(),
            by_table if known.leds is None else calibrated_positions(known.leds),
            lens_of(known.camera, frames),
            corners_of(corners),
            known.dark_record,
            known.response_record,
            known.flat,
            known.glare,
            emission_of(known.emission),
            tuple(path for path in files if path is not None),
        )
        with bar(console, "frames of the chart") as progress:
            sightings = see_in_runs(frames, setting, whites, progress)
        with bar(console, "patches left out") as progress:
            return colour_outcome(sightings, patches, setting, frames, request, progress)

    return work


def corners_of(words: str | None) -> Floats | None:
    """[4, 2] px of `X,Y X,Y X,Y X,Y`. Raises InputError for anything else."""
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

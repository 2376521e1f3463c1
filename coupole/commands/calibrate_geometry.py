"""`coupole calibrate leds` and `mesh`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.calibration.leds.acceptance import LEDS
from coupole.calibration.stickers.acceptance import MESH
from coupole.commands.calibrating import Work, arm_of, bar, calibration, rig_of

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.geometry import Transform
    from coupole.plan.cell import Cell

Runs = Annotated[list[Path], typer.Argument(help="Runs.", show_default=False, metavar="RUN...")]
HandEyeOption = Annotated[
    Path, typer.Option("--hand-eye", help="The hand-eye record, which also contains the lens.")
]
CameraOption = Annotated[
    Path | None, typer.Option("--camera", help="The camera's record, as a check that it is the same lens.")
]
_OF_THE_ROBOT = (
    "Noise of the robot from pose to pose, as stated. If the robot's absolute error is not "
    "calibrated, give the absolute error instead."
)
RepeatabilityMm = Annotated[float, typer.Option("--repeatability-mm", min=1e-4, help=_OF_THE_ROBOT)]
RepeatabilityDeg = Annotated[float, typer.Option("--repeatability-deg", min=1e-5, help=_OF_THE_ROBOT)]


@dataclass(frozen=True)
class RobotRepeatability:
    """Repeatability from pose to pose, as the maker states it."""

    repeatability_mm: RepeatabilityMm = 0.03
    repeatability_deg: RepeatabilityDeg = 0.003


@dataclass(frozen=True)
class ScannedStickers:
    """Size of the stickers, their distance from the camera, and the accuracy of the scanner."""

    diameter_mm: Annotated[float, typer.Option(min=1.0, max=50.0, help="Diameter of a sticker's bright disk.")] = (
        6.0
    )
    nearest_mm: Annotated[
        float, typer.Option(min=50.0, help="Smallest distance of a sticker from the camera.")
    ] = 200.0
    farthest_mm: Annotated[
        float, typer.Option(min=60.0, help="Largest distance of a sticker from the camera.")
    ] = 900.0
    scanner_mm: Annotated[float, typer.Option(min=1e-4, help="Accuracy that the scanner's maker states.")] = 0.03


@calibration("leds", limits=LEDS, lens=False)
def leds(
    runs: Runs,
    hand_eye: HandEyeOption,
    camera: CameraOption = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="The rig with the dome; by default the run's own.")
    ] = None,
    *,
    robot: RobotRepeatability,
    tolerance_mm: Annotated[
        float, typer.Option(min=1e-4, help="The maker's tolerance for the places of LEDs on their boards.")
    ] = 0.05,
    accept_faults: Annotated[
        bool,
        typer.Option(
            "--accept-faults", help="Accept dead, swapped and misplaced LEDs; the table holds what was measured."
        ),
    ] = False,
) -> Work:
    """Find positions and normals of all LEDs, from views of the lit LEDs. Each LED must be seen six times or more.

    If an LED is dead or wires are swapped, the record is not accepted and no table is written, unless you give
    --accept-faults.
    """
    from coupole.calibration.leds.drawing import draw_leds
    from coupole.calibration.leds.equations import Stated
    from coupole.calibration.leds.sources import find_leds
    from coupole.calibration.leds.workflow import leds_from
    from coupole.calibration.posed_camera import read_posed_camera
    from coupole.calibration.report import Outcome
    from coupole.storage.durable import sha256

    def work(console: Console, request: Request) -> Outcome:
        cell = _cell(rig, runs)
        table = cell.leds
        with bar(console, "looking for spots") as progress:
            images = find_leds(runs, table, progress)
        made_with = [(path.name, sha256(path)) for path in (hand_eye, camera, rig) if path is not None]
        images = replace(images, inputs=(*images.inputs, *made_with))
        console.print(
            f"{len(images.seen.led)} spots in {len(images.seen.frames)} images of {len(images.views)} views"
        )
        prior = read_posed_camera(hand_eye, camera, images.about, images.size_px)
        tolerances = Stated(
            tolerance_mm=tolerance_mm, robot_mm=robot.repeatability_mm, robot_deg=robot.repeatability_deg
        )
        with console.status("adjusting boards, poses, lens and hand-eye"):
            arm = arm_of(cell, hand_eye)
            calibration = leds_from(
                images, table, prior, request, stated_noise=tolerances, arm=arm, accept_faults=accept_faults
            )
        return Outcome(calibration.record, partial(draw_leds, calibration), calibration.files)

    return work


@calibration("mesh", limits=MESH, lens=False)
def mesh(
    runs: Runs,
    scan: Annotated[Path, typer.Option("--scan", help="Folder that `coupole scan` wrote, with targets.")],
    hand_eye: HandEyeOption,
    camera: CameraOption = None,
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="The rig, to print the mesh's place on the support as plans need it."),
    ] = None,
    *,
    stickers: ScannedStickers,
    robot: RobotRepeatability,
) -> Work:
    """Find the pose of a scanned object in the base, from its stickers in six views or more."""
    from coupole.calibration.calibrated_arm import CarriedCamera, has_axis_zeros
    from coupole.calibration.posed_camera import read_posed_camera
    from coupole.calibration.report import Outcome
    from coupole.calibration.sources import open_sources
    from coupole.calibration.stickers.drawing import draw_mesh
    from coupole.calibration.stickers.mesh_to_robot import Stated
    from coupole.calibration.stickers.sources import find_all_stickers, read_scan
    from coupole.calibration.stickers.workflow import mesh_from

    def work(console: Console, request: Request) -> Outcome:
        scanned_mesh, sources = read_scan(scan), open_sources(runs, None)
        for made_with in (hand_eye, camera, rig):
            sources = sources.with_file(made_with)
        size_px = sources.images[0].read_picture().size_px
        prior = read_posed_camera(hand_eye, camera, sources.about, size_px)
        depth_mm = (stickers.nearest_mm, stickers.farthest_mm)
        with bar(console, "looking for stickers") as progress:
            images = find_all_stickers(
                sources, prior.lens, diameter_mm=stickers.diameter_mm, depth_mm=depth_mm, progress=progress
            )
        console.print(f"{sum(map(len, images.stickers))} stickers in {len(images.names)} images")
        support = _base_from_support(_cell(rig, runs)) if rig is not None else None
        arm = arm_of(_cell(rig, runs), hand_eye) if has_axis_zeros(hand_eye) else None
        tolerances = Stated(
            scanner_mm=stickers.scanner_mm, robot_mm=robot.repeatability_mm, robot_deg=robot.repeatability_deg
        )
        calibration = mesh_from(
            images,
            sources,
            scanned_mesh,
            CarriedCamera(prior, arm),
            request,
            stated_noise=tolerances,
            base_from_support=support,
        )
        return Outcome(calibration.record, partial(draw_mesh, calibration))

    return work


def _base_from_support(cell: Cell) -> Transform:
    from coupole.geometry import transform

    place = cell.rig.support.base_from_support
    return transform(place.translation_mm, place.abc_deg)


def _cell(rig: Path | None, runs: list[Path]) -> Cell:
    """Read the named rig, or the rig of the first run if none is named."""
    from coupole.plan.cell import read_cell

    return read_cell(rig or rig_of(runs[0]))

"""`coupole calibrate camera`, `chromatic` and `hand-eye`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.calibration.lens.acceptance import CAMERA, CHROMATIC, HAND_EYE
from coupole.commands.calibrating import Paths, Work, bar, calibration
from coupole.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.lens.board import Board
    from coupole.calibration.lens.equations import EarlierLens
    from coupole.calibration.lens.images import Found
    from coupole.calibration.lens.workflow import Shown
    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.calibration.sources import Sources
    from coupole.kinematics import Arm

BoardOption = Annotated[
    Path | None, typer.Option("--board", help="The board's description (YAML); FOLDER/board.yaml if not given.")
]
PlainBoardOption = Annotated[
    str | None,
    typer.Option(
        "--board",
        help="The board's description (YAML), FOLDER/board.yaml if not given; or COLUMNSxROWS, inner corners of a "
        "plain chessboard, with --square.",
        show_default=False,
    ),
]
SquareOption = Annotated[
    float | None,
    typer.Option(
        "--square", help="Side of a plain chessboard's squares, mm.", min=0.01, max=1000.0, show_default=False
    ),
]
PosesOption = Annotated[
    Path | None, typer.Option("--poses", help="Robot poses of pictures (YAML); FOLDER/poses.yaml if not given.")
]
ModelOption = Annotated[str, typer.Option("--model", help="pinhole, radial (k1), brown4 or brown5 (with k3).")]


@dataclass(frozen=True)
class Warmth:
    """Temperature of a certified board while it was photographed."""

    celsius: Annotated[
        float | None,
        typer.Option(
            "--board-c",
            min=-50.0,
            max=100.0,
            help="Temperature of a board with a certificate, C; by default the temperature of the "
            "run's coolest LED board.",
            show_default=False,
        ),
    ] = None
    u_k: Annotated[
        float, typer.Option("--u-board-k", min=0.0, max=50.0, help="Standard uncertainty of --board-c, K.")
    ] = 0.5

    @property
    def pair(self) -> tuple[float | None, float]:
        """Temperature and its uncertainty, in the form that `sight_board` takes."""
        return self.celsius, self.u_k


@calibration("camera", limits=CAMERA)
def camera(
    paths: Paths,
    board: PlainBoardOption = None,
    square: SquareOption = None,
    model: ModelOption = "brown5",
    *,
    warmth: Warmth,
) -> Work:
    """Lens and distortion from 8 to 60 images of a board, tilted to all sides, corners over the whole field."""
    from coupole.calibration.lens.workflow import camera_from

    def work(console: Console, request: Request) -> Outcome:
        _refuse_unknown_model(model)
        plain_board = _plain_board(board, square)
        path = Path(board) if board is not None and plain_board is None else None
        sources, _, sightings = look_for_board(paths, path, None, console, warmth, plain_board)
        return _outcome_with_drawing(camera_from(sightings, sources, model, request)[1])

    return work


@calibration("chromatic", limits=CHROMATIC)
def chromatic(
    paths: Paths,
    board: BoardOption = None,
    model: ModelOption = "brown5",
    *,
    warmth: Warmth,
) -> Work:
    """Lateral shift of red and blue against green, from the images of a lens calibration."""
    from coupole.calibration.lens.chromatic_workflow import chromatic_from, draw_chromatic
    from coupole.calibration.report import Outcome

    def work(console: Console, request: Request) -> Outcome:
        _refuse_unknown_model(model)
        sources, target, sightings = look_for_board(paths, board, None, console, warmth)
        with console.status("adjusting a lens for each colour"):
            calibration = chromatic_from(sightings, sources, target, model, request)
        return Outcome(calibration.record, partial(draw_chromatic, calibration))

    return work


@dataclass(frozen=True)
class StatedRobot:
    """Repeatability of the robot, as its maker states it."""

    repeatability_mm: Annotated[
        float, typer.Option(min=1e-4, help="Repeatability of position, as stated by the robot's maker.")
    ] = 0.03
    repeatability_deg: Annotated[
        float, typer.Option(min=1e-5, help="Repeatability of orientation, as stated by the robot's maker.")
    ] = 0.003
    absolute_mm: Annotated[
        float, typer.Option(min=0.0, help="Absolute error of the robot's position, as stated by its maker.")
    ] = 0.3
    absolute_deg: Annotated[
        float,
        typer.Option(min=1e-5, help="Absolute error of the robot's orientation, or of the zero of each axis."),
    ] = 0.02


@calibration("hand-eye", limits=HAND_EYE)
def hand_eye(
    paths: Paths,
    board: BoardOption = None,
    poses: PosesOption = None,
    camera_record: Annotated[
        Path | None,
        typer.Option(
            "--camera", help="A camera's record from other images, which counts as an observation of the lens."
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            "--rig",
            help="The arm's rig. With the rig, the zero errors of the arm's axes are estimated too (for runs).",
        ),
    ] = None,
    *,
    robot: StatedRobot,
    warmth: Warmth,
    model: ModelOption = "brown5",
) -> Work:
    """Pose of the camera on the flange, from 10 to 60 images of a board that is not moved."""
    from coupole.calibration.lens.bundle import RobotNoise
    from coupole.calibration.lens.workflow import CameraArm, hand_eye_from

    def work(console: Console, request: Request) -> Outcome:
        _refuse_unknown_model(model)
        model_of_arm = _arm(rig)
        sources, target, sightings = look_for_board(paths, board, poses, console, warmth)
        earlier = _earlier_lens(camera_record, sources, sightings)
        sources = sources.with_file(camera_record).with_file(rig)
        noise = RobotNoise(robot.repeatability_mm, robot.repeatability_deg, robot.absolute_mm, robot.absolute_deg)
        with console.status("adjusting lens, hand-eye, board and the robot's errors"):
            arm = CameraArm(noise, model_of_arm)
            drawing = hand_eye_from(sightings, sources, target, model, request, arm=arm, lens=earlier)[2]
        return _outcome_with_drawing(drawing)

    return work


def _outcome_with_drawing(shown_lens: Shown) -> Outcome:
    from coupole.calibration.lens.drawing import draw_lens
    from coupole.calibration.report import Outcome

    return Outcome(shown_lens.record, partial(draw_lens, shown_lens))


def _refuse_unknown_model(model: str) -> None:
    from coupole.calibration.optics import MODELS

    if model not in MODELS:
        raise InputError(f"--model: expected one of {', '.join(MODELS)}; found {model}")


def _plain_board(text: str | None, square_mm: float | None) -> Board | None:
    """Return the plain chessboard COLUMNSxROWS with squares of the stated side; None if `text` names a file or is
    empty. Raises InputError if only one of the two is given, or if there can be no such board."""
    from coupole.scripting.analyses import plain_chessboard

    match = re.fullmatch(r"([0-9]{1,3})x([0-9]{1,3})", text or "")
    if match is None:
        if square_mm is not None:
            raise InputError(f"--square: belongs to a plain board, --board COLUMNSxROWS; got --board {text}")
        return None
    return plain_chessboard((int(match[1]), int(match[2])), square_mm)


def look_for_board(
    paths: list[Path],
    board: Path | None,
    poses: Path | None,
    console: Console,
    warmth: Warmth,
    plain_board: Board | None = None,
) -> tuple[Sources, Board, Found]:
    """Open the images and find the board in them."""
    from coupole.scripting.analyses import sight_board

    with bar(console, "looking for the board") as progress:
        sources, target, sightings = sight_board(paths, board, poses, plain_board, progress, warmth.pair)
    for line in sightings.left_out:
        console.print(f"[yellow]left out:[/] {line}")
    corners = sum(len(sighting.ids) for sighting in sightings.sightings)
    console.print(f"{corners} corners in {len(sightings.sightings)} of {len(sources.images)} images")
    return sources, target, sightings


def _earlier_lens(path: Path | None, sources: Sources, board_images: Found) -> EarlierLens | None:
    """The lens of a camera record, with its covariance. Raises InputError if the record is not valid for these
    images."""
    from coupole.calibration.earlier import read_earlier, refuse_same_images
    from coupole.calibration.lens.equations import EarlierLens
    from coupole.calibration.record import intrinsics_of

    if path is None:
        return None
    record = read_earlier(path, "camera", sources.about, board_images.size_px)
    refuse_same_images(path, record, sources.inputs)
    intrinsics, free = intrinsics_of(record)
    return EarlierLens(intrinsics, free, record.covariance_matrix)


def _arm(rig: Path | None) -> Arm | None:
    from coupole.plan.cell import read_cell
    from coupole.plan.rig_devices import planning_arm

    if rig is None:
        return None
    arm = planning_arm(read_cell(rig).rig)
    if arm is None:
        raise InputError(f"{rig}: its robot's driver knows no model of the arm; leave --rig out")
    return arm

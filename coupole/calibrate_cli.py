"""`coupole calibrate`: from runs or folders of pictures to a record and its report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.errors import CalibrationRefused, CoupoleError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.board import Board
    from coupole.calibration.bundle import EarlierLens
    from coupole.calibration.record import Record
    from coupole.calibration.sources import Found, Sources
    from coupole.calibration.workflow import Shown, Wish
    from coupole.kinematics import Arm

calibrate_app = typer.Typer(
    help="Calibrations: a record with uncertainties, and its report.", no_args_is_help=True
)

Paths = Annotated[
    list[Path],
    typer.Argument(help="Runs, or one folder of pictures.", show_default=False, metavar="RUN_OR_FOLDER..."),
]
BoardOption = Annotated[
    Path | None, typer.Option("--board", help="The board's description (YAML); FOLDER/board.yaml if not given.")
]
PosesOption = Annotated[
    Path | None, typer.Option("--poses", help="Robot poses of pictures (YAML); FOLDER/poses.yaml if not given.")
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the record, its page and its picture.")]
NameOption = Annotated[str | None, typer.Option("--name", help="Of the record; kind and date if not given.")]
ModelOption = Annotated[str, typer.Option("--model", help="pinhole, radial (k1), brown4 or brown5 (with k3).")]
LensOption = Annotated[str | None, typer.Option("--lens", help="Which lens it is, in words.")]
DaysOption = Annotated[int, typer.Option("--valid-days", min=1, max=3650, help="When the record expires.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


@calibrate_app.command("camera")
def camera(
    paths: Paths,
    board: BoardOption = None,
    model: ModelOption = "brown5",
    out: OutOption = Path("calibrations"),
    name: NameOption = None,
    lens: LensOption = None,
    valid_days: DaysOption = 180,
    as_json: JsonOption = False,
) -> None:
    """Lens and distortion from 8 to 60 images of a board, tilted to all sides, corners over the whole field."""
    from coupole.calibration.workflow import camera_from

    def work(console: Console, wish: Wish) -> Shown:
        sources, _, found = _look(paths, board, None, console)
        return camera_from(found, sources, model, wish)[1]

    _calibrate("camera", work, model=model, out=out, name=name, lens=lens, valid_days=valid_days, as_json=as_json)


@calibrate_app.command("hand-eye")
def hand_eye(
    paths: Paths,
    board: BoardOption = None,
    poses: PosesOption = None,
    camera_record: Annotated[
        Path | None,
        typer.Option("--camera", help="A camera's record, which counts as an observation of the lens."),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="The rig, whose arm's axes may have zero errors (for runs).")
    ] = None,
    repeatability_mm: Annotated[float, typer.Option(min=1e-4, help="Of the robot, as stated.")] = 0.03,
    repeatability_deg: Annotated[float, typer.Option(min=1e-5, help="Of the robot, as stated.")] = 0.003,
    absolute_mm: Annotated[float, typer.Option(min=0.0, help="The robot's absolute error, as stated.")] = 0.3,
    absolute_deg: Annotated[float, typer.Option(min=1e-5, help="Of orientation, or of each axis' zero.")] = 0.02,
    model: ModelOption = "brown5",
    out: OutOption = Path("calibrations"),
    name: NameOption = None,
    lens: LensOption = None,
    valid_days: DaysOption = 180,
    as_json: JsonOption = False,
) -> None:
    """Where the camera sits on the flange, from 10 to 60 images of a board that stands still."""
    from coupole.calibration.bundle import RobotNoise
    from coupole.calibration.workflow import hand_eye_from

    def work(console: Console, wish: Wish) -> Shown:
        earlier, arm = _earlier_lens(camera_record), _arm(rig)
        sources, described, found = _look(paths, board, poses, console)
        sources = sources.with_file(camera_record).with_file(rig)
        robot = RobotNoise(repeatability_mm, repeatability_deg, absolute_mm, absolute_deg)
        with console.status("adjusting lens, hand-eye, board and the robot's errors"):
            return hand_eye_from(found, sources, described, model, wish, robot=robot, arm=arm, lens=earlier)[2]

    _calibrate(
        "hand-eye", work, model=model, out=out, name=name, lens=lens, valid_days=valid_days, as_json=as_json
    )


def _calibrate(
    kind: str,
    work: Callable[[Console, Wish], Shown],
    *,
    model: str,
    out: Path,
    name: str | None,
    lens: str | None,
    valid_days: int,
    as_json: bool,
) -> None:
    """Do the work, write its record and report, say what was found, refuse what misses its limits."""
    from coupole.calibration.record import write_record
    from coupole.calibration.report import write_report
    from coupole.calibration.workflow import Wish
    from coupole.console import make_console

    console = make_console(quiet=as_json)
    now = datetime.now(UTC)
    try:
        _refuse_unknown_model(model)
        wish = Wish(name or f"{kind}-{now:%Y%m%d}", now, valid_days, lens)
        record_path = out / f"{wish.name}.yaml"
        if record_path.exists():
            raise InputError(f"{record_path}: a record stands here already. Choose another --name or --out.")
        shown = work(console, wish)
        write_record(record_path, shown.record)
        page, picture = write_report(out, shown)
    except CoupoleError as error:
        if as_json:
            print(json.dumps({"error": str(error), "kind": type(error).__name__, "exit_code": error.exit_code}))
        raise
    _show(console, shown.record)
    console.print(f"record {record_path}, report {page}")
    if as_json:
        files = {
            "record": str(record_path.resolve()),
            "report": str(page.resolve()),
            "picture": str(picture.resolve()),
        }
        print(json.dumps(files | _figures(shown.record)))
    if not shown.record.passed:
        raise CalibrationRefused(
            [
                f"{record_path}: not accepted: {limit.what} is {limit.found:.3g} {limit.unit}, at most "
                f"{limit.limit:.3g} is allowed"
                for limit in shown.record.limits
                if not limit.passed
            ]
        )


def _refuse_unknown_model(model: str) -> None:
    from coupole.calibration.optics import MODELS

    if model not in MODELS:
        raise InputError(f"--model: expected one of {', '.join(MODELS)}; found {model}")


def _look(
    paths: list[Path], board: Path | None, poses: Path | None, console: Console
) -> tuple[Sources, Board, Found]:
    """Open the images and find the board in them."""
    from coupole.calibration.board import read_board
    from coupole.calibration.sources import BOARD_NAME, find_board, open_sources

    beside = paths[0] / BOARD_NAME
    if board is None and not beside.is_file():
        raise InputError(f"expected the board's description: give --board, or put it at {beside}")
    described = read_board(board or beside)
    sources = open_sources(paths, poses).with_file(board or beside)
    with _bar(console, "looking for the board") as progress:
        found = find_board(described, sources, progress)
    for line in found.left_out:
        console.print(f"[yellow]left out:[/] {line}")
    corners = sum(len(seen.ids) for seen in found.sightings)
    console.print(f"{corners} corners in {len(found.sightings)} of {len(sources.images)} images")
    return sources, described, found


@contextmanager
def _bar(console: Console, what: str) -> Iterator[Callable[[int, int], None]]:
    from rich.progress import Progress

    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(what)
        yield lambda done, total: bars.update(bar, completed=done, total=total)


def _earlier_lens(path: Path | None) -> EarlierLens | None:
    """The lens of a camera's record, with its covariance."""
    from coupole.calibration.bundle import EarlierLens
    from coupole.calibration.record import intrinsics_of, read_record

    if path is None:
        return None
    record = read_record(path)
    if record.kind != "camera":
        raise InputError(f"{path}: expected a camera's record, found one of the kind `{record.kind}`")
    intrinsics, free = intrinsics_of(record)
    return EarlierLens(intrinsics, free, record.covariance_matrix)


def _arm(rig: Path | None) -> Arm | None:
    from coupole.job import read_cell
    from coupole.rig import planning_arm

    if rig is None:
        return None
    arm = planning_arm(read_cell(rig).rig)
    if arm is None:
        raise InputError(f"{rig}: its robot's driver knows no model of the arm; leave --rig out")
    return arm


def _show(console: Console, record: Record) -> None:
    """The figures, for people."""
    from rich.table import Table

    for name, pose in record.transforms.items():
        shift = " ".join(f"{v:.4f}" for v in pose.translation_mm)
        console.print(f"{name}: {shift} mm, A B C {' '.join(f'{v:.5f}' for v in pose.abc_deg)} deg")
    table = Table("parameter", "value", "u", "most of it from", box=None)
    for p in record.parameters:
        table.add_row(p.name, "" if p.value is None else f"{p.value:.6g}", f"{p.u:.2g}", p.dominated_by)
    console.print(table)
    for remark in record.remarks:
        console.print(f"[yellow]{remark}[/]")
    for limit in record.limits:
        colour, how = ("green", "met") if limit.passed else ("red", "missed")
        console.print(
            f"[{colour}]{how}[/] {limit.what}: {limit.found:.3g} {limit.unit} (at most {limit.limit:.3g})"
        )


def _figures(record: Record) -> dict[str, Any]:
    """The figures, for programs."""
    return {
        "kind": record.kind,
        "accepted": record.passed,
        "sha256": record.sha256,
        "images": len(record.images),
        "corners": sum(image.corners for image in record.images),
        "rejected": sum(image.rejected for image in record.images),
        "parameters": {p.name: {"value": p.value, "u": p.u} for p in record.parameters},
        "transforms": {name: pose.model_dump() for name, pose in record.transforms.items()},
        "noise": {n.name: {"found": n.found, "stated": n.stated, "unit": n.unit} for n in record.noise},
        "limits": [{**limit.model_dump(), "passed": limit.passed} for limit in record.limits],
        "remarks": list(record.remarks),
    }

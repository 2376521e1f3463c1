"""Calibrates a random cell from rendered frames to records, and compares the records with the truth.

Frames are rendered by `sim` and evaluated by `coupole.calibration`, which share no code. The compared results are
those in the records: camera, hand-eye, LEDs, and the pose of a scanned mesh.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coupole.appearance.render.led_squares import read_leds
from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.calibrated_arm import CalibratedArm, CarriedCamera, calibrated_poses, read_arm
from coupole.calibration.leds.equations import Stated as StatedOfLeds
from coupole.calibration.leds.workflow import leds_from
from coupole.calibration.lens.board import Board
from coupole.calibration.lens.bundle import RobotNoise
from coupole.calibration.lens.images import find_board
from coupole.calibration.lens.workflow import CameraArm, camera_from, hand_eye_from
from coupole.calibration.posed_camera import CameraPrior, read_posed_camera
from coupole.calibration.record import Record, write_record
from coupole.calibration.request import Request
from coupole.calibration.sources import About
from coupole.calibration.stickers.mesh_to_robot import Stated as StatedOfMesh
from coupole.calibration.stickers.sources import Scan, find_all_stickers, read_scan
from coupole.calibration.stickers.workflow import mesh_from
from coupole.errors import CoupoleError
from coupole.geometry import apply, inverse, transform
from coupole.kinematics import Arm
from coupole.plan.rig_devices import planning_arm
from coupole.viewing.scan_sheet import import_scan
from random_cells import (
    LED_BOARDS,
    MARKER_MM,
    SQUARE_MM,
    SQUARES,
    STICKER_MM,
    STICKERS,
    THICKNESS_MM,
    Floats,
    Photographs,
    Postures,
    RandomCell,
    some_leds,
)
from ray_proof import LIGHT_STRANGERS, has_truth, judged_rays, true_board
from sim.devices.kuka_kinematics import flange_pose
from sim.devices.scanner import export_scan, scanner_from_thing
from sim.optics.dome import as_built

STEPS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")


@dataclass(frozen=True)
class Judged:
    """One parameter of one cell, compared with the truth."""

    name: str
    error: float
    u: float
    half_width: float
    """Half width of the parameter's 95 % interval."""


@dataclass(frozen=True)
class Proof:
    """Comparison of one cell's records with the truth."""

    judged: list[Judged]
    accuracy: dict[str, float]
    """Distances from the truth in mm and degrees, by name. Names with `_in_true_base` include the arm's common
    error."""
    refused: str | None = None
    """Reason why a calibration of this cell was refused, or why its record exceeded its limits; None if all were
    accepted."""


def prove_cell(
    seed: int, *, at: Postures, width_px: int, samples: int, absolute: bool, stranger: str | None = None
) -> Proof:
    """Render, detect, adjust, and compare the records with the truth."""
    cell = RandomCell(seed, width_px, samples, absolute, stranger)
    if stranger is not None:
        return _prove_strange_cell(cell, at)
    request = Request(f"cell{seed}", datetime.now(UTC))
    model: Arm | None = planning_arm(cell.cell.rig) if absolute else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        camera, hand_eye = _camera_and_hand_eye(cell, at, request, model)
        write_record(folder / "hand-eye.yaml", hand_eye)
        prior = read_posed_camera(folder / "hand-eye.yaml", None, About(is_simulated=True), cell.size_px)
        arm = None if model is None else read_arm(folder / "hand-eye.yaml", model)
        proof = Proof([*_of_camera(cell, camera), *_of_hand_eye(cell, hand_eye)], {})
        _far(proof, "camera_mm", cell, *_camera_centres_mm(cell, at, prior, arm))
        _prove_leds(proof, cell, at, request, prior, arm)
        _prove_mesh(proof, cell, at, request, prior, arm, folder)
    return proof


def _prove_strange_cell(cell: RandomCell, at: Postures) -> Proof:
    """Return camera and hand-eye, by their rays and by the parameters that have a truth; and LEDs if the stranger
    is theirs. A refusal is a result."""
    request = Request(f"cell{cell.seed}", datetime.now(UTC))
    model: Arm | None = planning_arm(cell.cell.rig) if cell.absolute else None
    try:
        camera, hand_eye = _camera_and_hand_eye(cell, at, request, model)
        if faults := [*_missed_limits(camera), *_missed_limits(hand_eye)]:
            return Proof([], {}, "; ".join(faults))
        judgements = [Judged(*judgement) for judgement in judged_rays(cell, camera, hand_eye, at.board)]
        judgements += [judgement for judgement in _of_hand_eye(cell, hand_eye) if has_truth(cell, judgement.name)]
        proof = Proof(judgements, {})
        if cell.stranger in LIGHT_STRANGERS:
            with tempfile.TemporaryDirectory() as name:
                write_record(Path(name) / "hand-eye.yaml", hand_eye)
                prior = read_posed_camera(
                    Path(name) / "hand-eye.yaml", None, About(is_simulated=True), cell.size_px
                )
            _prove_leds(proof, cell, at, request, prior, None)
    except CoupoleError as error:
        return Proof([], {}, str(error))
    return proof


def _missed_limits(record: Record) -> Iterator[str]:
    for limit in record.limits:
        if not limit.is_met:
            yield f"{record.kind}: {limit.what} above its limit"


def _far(proof: Proof, name: str, cell: RandomCell, found_mm: Floats, true_mm: Floats) -> None:
    """Add median and largest distance of points [n, 3] in the base frame from their true positions."""
    own_from_base = cell.own_base(np.eye(4))
    own_mm = true_mm @ own_from_base[:3, :3].T + own_from_base[:3, 3]
    for suffix, there_mm in (("", own_mm), ("_in_true_base", true_mm)):
        off_mm = np.linalg.norm(found_mm - there_mm, axis=1)
        proof.accuracy[f"{name}{suffix}"] = float(np.median(off_mm))
        proof.accuracy[f"{name}_worst{suffix}"] = float(off_mm.max())


def _camera_centres_mm(
    cell: RandomCell, at: Postures, prior: CameraPrior, arm: CalibratedArm | None
) -> tuple[Floats, Floats]:
    """Camera positions at the board's postures: by the records, and true without the arm's repeatability."""
    poses = np.stack([flange_pose(joints) for joints in at.board])
    steady = replace(cell.arm_errors, repeatability_um=0.0, repeatability_deg=0.0)
    true = np.stack([steady.true_flange_pose(joints, 0) for joints in at.board]) @ cell.flange_from_camera
    if arm is not None:
        poses, prior = calibrated_poses(poses, at.board, arm, prior)
    return (poses @ prior.flange_from_camera)[:, :3, 3], true[:, :3, 3]


def _camera_and_hand_eye(
    cell: RandomCell, at: Postures, request: Request, model: Arm | None
) -> tuple[Record, Record]:
    place = cell.place(0)
    thing = {"kind": "charuco_board", "square_mm": SQUARE_MM, "marker_mm": MARKER_MM, "thickness_mm": THICKNESS_MM}
    sources = Photographs(cell, at.board, 0, thing | place).sources()
    board = Board(
        kind="charuco", corners=(SQUARES[0] - 1, SQUARES[1] - 1), square_mm=SQUARE_MM, marker_mm=MARKER_MM
    )
    detections = find_board(board, sources)
    off = (0.3, 0.02) if cell.absolute else (0.0, 1e-5)
    robot = RobotNoise(absolute_mm=off[0], absolute_deg=off[1])
    camera = camera_from(detections, sources, "brown4", request)[1].record
    return camera, hand_eye_from(detections, sources, board, "brown4", request, arm=CameraArm(robot, model))[
        2
    ].record


def _of_camera(cell: RandomCell, record: Record) -> Iterator[Judged]:
    for parameter in record.parameters:
        assert parameter.value is not None
        error = parameter.value - cell.true_lens[parameter.name]
        yield _judge(f"camera.{parameter.name}", error, parameter.u, parameter.degrees_of_freedom)


def _of_hand_eye(cell: RandomCell, record: Record) -> Iterator[Judged]:
    true = {
        "flange_from_camera": cell.flange_from_camera,
        "base_from_board": cell.shifted_base(true_board(cell)),  # the zero of A1 is included in its interval
    }
    by_name = {parameter.name: parameter for parameter in record.parameters}
    for name, pose in record.transforms.items():
        estimated_pose = transform(pose.translation_mm, pose.abc_deg)
        for step, error in zip(STEPS, _error(estimated_pose, true[name]), strict=True):
            parameter = by_name[f"{name}.{step}"]
            yield _judge(parameter.name, error, parameter.u, parameter.degrees_of_freedom)


def _prove_leds(
    proof: Proof, cell: RandomCell, at: Postures, request: Request, prior: CameraPrior, arm: CalibratedArm | None
) -> None:
    random = np.random.default_rng((cell.seed, 4))
    some = at.boards_of_leds[int(random.integers(len(at.boards_of_leds)))]
    boards = set(random.permutation(some)[:LED_BOARDS].tolist())
    table = some_leds(cell.cell.leds, list(boards))
    views = [number for number, lit in enumerate(at.boards_of_leds) if boards & set(lit)]
    lit = [
        (number, int(row))
        for number, view in enumerate(views)
        for row in np.flatnonzero(np.isin(table.boards, list(boards & set(at.boards_of_leds[view]))))
    ]
    photographs = Photographs(cell, at.leds[views], 1000)
    truth = as_built(read_leds(photographs.truth.scene.leds), photographs.truth.settings.dome)
    stated_tolerances = StatedOfLeds(tolerance_mm=0.05)
    geometry = leds_from(
        photographs.leds(table, lit), table, prior, request, stated_noise=stated_tolerances, arm=arm
    ).geometry
    row_of = {int(led): row for row, led in enumerate(truth.ids)}
    at_truth = [row_of[int(led)] for led in table.ids]
    own_from_base = cell.own_base(np.eye(4))
    true_mm = truth.positions_mm[at_truth] @ own_from_base[:3, :3].T + own_from_base[:3, 3]
    normals = truth.normals[at_truth] @ own_from_base[:3, :3].T
    _far(proof, "led_mm", cell, geometry.centres_mm, truth.positions_mm[at_truth])
    for led, covariance in enumerate(geometry.centre_covariance):
        u = np.sqrt(np.diag(covariance))
        for axis, error in enumerate(geometry.centres_mm[led] - true_mm[led]):
            proof.judged.append(_judge(f"leds.{'xyz'[axis]}_mm", error, u[axis]))
    tilts_deg = []
    for number, board in enumerate(np.unique(table.boards)):
        row_of_board = int(np.flatnonzero(table.boards == board)[0])
        true_normal = geometry.state.base_from_board[number, :3, :3].T @ normals[row_of_board]
        u = np.sqrt(np.diag(geometry.normal_covariance[number]))
        tilts_deg.append(float(np.degrees(np.linalg.norm(true_normal[:2]))))
        for axis, error in enumerate(np.degrees([-true_normal[1], true_normal[0]])):
            proof.judged.append(_judge(f"leds.normal_r{'xy'[axis]}_deg", float(error), u[axis]))
    proof.accuracy["led_normal_deg"] = float(np.median(tilts_deg))
    proof.accuracy["led_normal_deg_worst"] = max(tilts_deg)


def _prove_mesh(
    proof: Proof,
    cell: RandomCell,
    at: Postures,
    request: Request,
    prior: CameraPrior,
    arm: CalibratedArm | None,
    folder: Path,
) -> None:
    place = cell.place(1)
    thing = {"kind": "sculpted_relief", "stickers": {"count": STICKERS, "seed": cell.seed}} | place
    scan = _scan_of(thing, cell.seed, folder)
    sources = Photographs(cell, at.mesh, 2000, thing).sources()
    depth_mm = (200.0, 900.0)
    images = find_all_stickers(sources, prior.lens, diameter_mm=STICKER_MM, depth_mm=depth_mm)
    stated_tolerances = StatedOfMesh(scanner_mm=0.03, robot_mm=0.03, robot_deg=0.003)
    camera = CarriedCamera(prior, arm)
    mesh_pose = mesh_from(images, sources, scan, camera, request, stated_noise=stated_tolerances).pose
    in_support = transform(place["translation_mm"], place["abc_deg"])
    true = cell.base_from_support @ in_support @ inverse(scanner_from_thing(cell.seed))
    u = np.sqrt(np.diag(mesh_pose.covariance))
    for step, error, u_of_step in zip(
        STEPS, _error(mesh_pose.base_from_mesh, cell.own_base(true)), u, strict=True
    ):
        proof.judged.append(_judge(f"base_from_mesh.{step}", error, u_of_step))
    _far(proof, "mesh_mm", cell, apply(mesh_pose.base_from_mesh, scan.targets_mm), apply(true, scan.targets_mm))


def _scan_of(thing: dict[str, Any], seed: int, folder: Path) -> Scan:
    mesh, targets = export_scan(thing, folder / "scanner", seed=seed)
    import_scan(
        mesh,
        targets,
        folder / "scan",
        unit="mm",
        targets_unit=None,
        accept_defects=False,
        progress=lambda what: None,
    )
    return read_scan(folder / "scan")


def _error(estimate: Floats, true: Floats) -> Floats:
    """[6] error of a transform: mm along the left frame's axes, degrees about the right frame's axes."""
    turn = Rotation.from_matrix(true[:3, :3].T @ estimate[:3, :3]).as_rotvec(degrees=True)
    return np.array([*(estimate[:3, 3] - true[:3, 3]), *turn])


def _judge(name: str, error: float, u: float, degrees: float = np.inf) -> Judged:
    return Judged(name, float(error), float(u), float(coverage_factor(min(degrees, 1e9))) * float(u))

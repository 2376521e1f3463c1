"""A simulated cell drawn at random, calibrated from rendered frames to records, and held against the truth.

Frames are rendered by `sim`, found and adjusted by `coupole.calibration`, which share no code; what is judged is
what stands in the records: camera, hand-eye, LEDs, and where a scanned mesh lies.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.calibrated_arm import CalibratedArm, calibrated_poses, read_arm
from coupole.calibration.leds.equations import Stated as StatedOfLeds
from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.plan import led_plan
from coupole.calibration.leds.sources import LedImages
from coupole.calibration.leds.spots import find_spots
from coupole.calibration.leds.workflow import leds_from
from coupole.calibration.lens.board import Board
from coupole.calibration.lens.bundle import RobotNoise
from coupole.calibration.lens.images import find_board
from coupole.calibration.lens.workflow import camera_from, hand_eye_from
from coupole.calibration.picture import Picture
from coupole.calibration.posed_camera import CameraPrior, read_posed_camera
from coupole.calibration.poses import reported
from coupole.calibration.record import Record, write_record
from coupole.calibration.sources import About, Source, Sources
from coupole.calibration.stickers.mesh_to_robot import Stated as StatedOfMesh
from coupole.calibration.stickers.sources import Scan, find_all_stickers, read_scan
from coupole.calibration.stickers.workflow import mesh_from
from coupole.calibration.wish import Wish
from coupole.cell import world_config
from coupole.dome import LedTable
from coupole.geometry import apply, inverse, transform
from coupole.itinerary import plan_itinerary
from coupole.job import Cell, read_cell, read_job
from coupole.kinematics import Arm
from coupole.rig import planning_arm
from coupole.scan import import_scan
from coupole.templates import TEMPLATES
from sim.config import Config
from sim.dome import as_built
from sim.kuka_kinematics import PoseErrors, flange_pose
from sim.scanner import export_scan, scanner_from_thing
from sim.scene import read_leds
from sim.stills import Stills

ROOT = Path(__file__).resolve().parents[1]
RIG = ROOT / "configs/rigs/sim-imperfect.yaml"
EXPOSURE_S = 0.001
LAMPS, LAMPS_ELEVATION_DEG = 6, 62.0
"""LEDs that light board and object, all round it: a few, as each is shaded by itself."""
SQUARES, SQUARE_MM, MARKER_MM, THICKNESS_MM = (12, 9), 16.0, 9.6, 4.0
STICKERS, STICKER_MM = 16, 6.0
LED_BOARDS, MESH_IMAGES = 8, 10
_MIDDLE_BOARD = 60
FULL_WIDTH_PX, FULL_PITCH_UM = 4096, 5.5
STEPS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Judged:
    """One parameter of one cell."""

    name: str
    error: float
    u: float
    half_width: float
    """Of its 95 % interval."""


@dataclass(frozen=True)
class Proof:
    """What one cell's records are worth."""

    judged: list[Judged]
    accuracy: dict[str, float]
    """Distances from the truth in mm and deg, by name; `_in_true_base`: with what the arm is off as a whole."""


@dataclass(frozen=True)
class Postures:
    """The arm's angles for each acquisition, in degrees; the same for all cells."""

    board: Floats
    """[n, 6]."""
    mesh: Floats
    """[n, 6]."""
    leds: Floats
    """[v, 6]."""
    boards_of_leds: tuple[tuple[int, ...], ...]
    """[v] boards of the dome that are lit at each."""


def postures(images: int, *, led_boards: int | None = None) -> Postures:
    """As `coupole plan new` wants them; so many images of the calibration board, and LEDs of so many boards that
    stand together in the dome, instead of all."""
    cell = read_cell(RIG)
    middles_mm = cell.leds.positions_mm.reshape(-1, 6, 3).mean(axis=1)
    nearest = np.argsort(np.linalg.norm(middles_mm - middles_mm[_MIDDLE_BOARD], axis=1))[:led_boards]
    cell = replace(cell, leds=some_leds(cell.leds, cell.leds.boards[::6][nearest]))
    with tempfile.TemporaryDirectory() as folder:
        board, mesh = (_itinerary(Path(folder), TEMPLATES[name]) for name in ("charuco", "mesh"))
        plan = Path(folder) / "leds.yaml"
        plan.write_text(led_plan(cell, name="leds", rig=str(RIG)))
        views = read_job(plan).plan.views
    return Postures(
        _some(board, images),
        _some(mesh, MESH_IMAGES),
        np.array([view.joints_deg for view in views]),
        tuple(view.lights.boards for view in views),
    )


def some_leds(table: LedTable, boards: Sequence[int] | NDArray[np.int64]) -> LedTable:
    """The part of a dome's table that is on these boards."""
    rows = np.isin(table.boards, boards)
    return LedTable(
        table.ids[rows], table.boards[rows], table.positions_mm[rows], table.normals[rows], table.flux_lm[rows]
    )


def lamps(table: LedTable, base_from_support: Floats) -> list[int]:
    """LEDs nearest to so many directions about the support."""
    azimuths = np.radians(np.arange(LAMPS) * 360.0 / LAMPS)
    elevation = np.radians(LAMPS_ELEVATION_DEG)
    wanted = np.stack(
        [
            np.cos(azimuths) * np.cos(elevation),
            np.sin(azimuths) * np.cos(elevation),
            np.full(LAMPS, np.sin(elevation)),
        ]
    )
    there = apply(inverse(base_from_support), table.positions_mm)
    nearest = np.argmax(there / np.linalg.norm(there, axis=1, keepdims=True) @ wanted, axis=0)
    return [int(led) for led in table.ids[nearest]]


def _itinerary(folder: Path, template: str) -> Floats:
    plan = folder / "plan.yaml"
    plan.write_text(template.format(name="prove", rig=RIG))
    job = read_job(plan)
    visits = plan_itinerary(job.schedule.views, job.cell.rig, None, job.cell.rig.motion.home_joints_deg).visits
    return np.array([visit.joints_deg for visit in visits if visit is not None])


def _some(joints_deg: Floats, count: int) -> Floats:
    return joints_deg[np.unique(np.linspace(0, len(joints_deg) - 1, count).astype(int))]


# -- a cell and its truth ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class RandomCell:
    """A cell: lens, hand-eye, arm, dome, and the places of board and object, drawn by its seed."""

    seed: int
    width_px: int
    samples: int
    """Rays a pixel and direction."""
    absolute: bool
    """The arm is off by 0.3 mm and 0.02 deg besides its repeatability."""

    @cached_property
    def cell(self) -> Cell:
        return read_cell(RIG)

    @property
    def size_px(self) -> tuple[int, int]:
        return self.width_px, self.width_px * 3 // 4

    @cached_property
    def arm_errors(self) -> PoseErrors:
        return PoseErrors(self.seed, 30.0, 0.003, 0.3 if self.absolute else 0.0, 0.02 if self.absolute else 0.0)

    @cached_property
    def flange_from_camera(self) -> Floats:
        random = np.random.default_rng((self.seed, 1))
        return transform(
            np.array([0.0, 0.0, 120.0]) + random.normal(0.0, 2.0, 3), tuple(random.normal(0.0, 0.7, 3))
        )

    @cached_property
    def lens(self) -> dict[str, float]:
        """Focus and distortion."""
        random = np.random.default_rng((self.seed, 2))
        figures = (random.uniform(330.0, 342.0), random.normal(-0.03, 0.01), *random.normal(0.0, 1e-4, 2))
        return dict(zip(("focus_mm", "k1", "p1", "p2"), map(float, figures), strict=True))

    def place(self, purpose: int) -> dict[str, Any]:
        """Of a thing on the support, in the support's frame."""
        random = np.random.default_rng((self.seed, 3, purpose))
        return {
            "translation_mm": [*random.uniform(-8.0, 8.0, 2), 0.0],
            "abc_deg": [float(random.uniform(-15.0, 15.0)), 0.0, 0.0],
        }

    @property
    def pitch_um(self) -> float:
        return FULL_PITCH_UM * FULL_WIDTH_PX / self.width_px

    @property
    def true_lens(self) -> dict[str, float]:
        """As records name its parameters."""
        focal_px = 1e3 / self.pitch_um / (1.0 / self.cell.rig.lens.focal_length_mm - 1.0 / self.lens["focus_mm"])
        bent = {name: self.lens[name] for name in ("k1", "p1", "p2")}
        middle = {"cx_px": 0.5 * (self.size_px[0] - 1), "cy_px": 0.5 * (self.size_px[1] - 1)}
        return {"fx_px": focal_px, "fy_px": focal_px, **middle, **bent, "k2": 0.0}

    def config(self, *things: dict[str, Any]) -> dict[str, Any]:
        """Of its world, with things on the support."""
        width_px, height_px = self.size_px
        sensor = self.cell.rig.sensor.model_copy(
            update={"width_px": width_px, "height_px": height_px, "pixel_pitch_um": self.pitch_um}
        )
        config = world_config(self.cell, None, sensor)
        config["camera"] |= {
            "flange_from_camera": self.flange_from_camera.tolist(),
            "focus_distance_mm": self.lens["focus_mm"],
        }
        distortion = (self.lens["k1"], 0.0, self.lens["p1"], self.lens["p2"], 0.0)
        config["settings"] |= {
            "seed": self.seed,
            "things": list(things),
            "arm_shadows": False,
            "camera": {"kind": "memory", "samples_per_side": self.samples, "distortion": distortion},
            "dome": {"seed": self.seed, "board_shift_mm": 1.0, "board_turn_deg": 0.2, "led_shift_mm": 0.05},
        }
        return config

    def own_base(self, in_base: Floats) -> Floats:
        """Poses [..., 4, 4] of the base in the base that the arm itself has: what it is off by the same in all
        poses (a shift, and a turn by its first axis) no image tells."""
        shift = transform(tuple(self.arm_errors.base_error_mm()), (0.0, 0.0, 0.0))
        zero_deg = float(self.arm_errors.axis_zero_error_deg()[0])
        first = flange_pose((zero_deg, 0, 0, 0, 0, 0)) @ inverse(flange_pose((0, 0, 0, 0, 0, 0)))
        return inverse(shift @ first) @ in_base

    @property
    def base_from_support(self) -> Floats:
        return self.cell.rig.support.base_from_support.matrix()


# -- its frames -------------------------------------------------------------------------------------------


class Photographs:
    """Frames of one acquisition, and the poses that the robot reports; each is rendered when it is asked for."""

    def __init__(self, cell: RandomCell, joints_deg: Floats, first_stop: int, *things: dict[str, Any]) -> None:
        config = cell.config(*things)
        self.camera = config["camera"]
        self.truth = Config.model_validate(config)
        self._stills = Stills(config)
        self._joints_deg = joints_deg
        self._lamps = lamps(cell.cell.leds, cell.base_from_support)
        self.reported = np.stack([flange_pose(joints) for joints in joints_deg])
        self._true = [
            cell.arm_errors.true_flange_pose(joints, first_stop + stop) for stop, joints in enumerate(joints_deg)
        ]

    def frame(self, number: int, leds: Sequence[int]) -> NDArray[np.uint16]:
        return self._stills.take(self._true[number], leds=leds, panels=[], exposure_s=EXPOSURE_S)

    def sources(self) -> Sources:
        """As a run of the things on the support would give them."""
        white = self.white_dn - self.camera["black_dn"]

        def read(number: int) -> Picture:
            frame = self.frame(number, self._lamps).astype(np.float64)
            return Picture(frame - self.camera["black_dn"], self.camera["bayer_pattern"], white, str(number))

        images = tuple(
            Source(str(number), partial(read, number), tuple(joints))
            for number, joints in enumerate(self._joints_deg.tolist())
        )
        return Sources(images, reported(self.reported), About(simulated=True), (("rendered", "0" * 64),))

    def leds(self, table: LedTable, lit: Sequence[tuple[int, int]]) -> LedImages:
        """Spots of LEDs: `lit` has view and row of the table of each frame."""
        spots = []
        for view, row in lit:
            frame = self.frame(view, [int(table.ids[row])])
            found = find_spots(frame, float(self.camera["black_dn"]), self.camera["bayer_pattern"], self.white_dn)
            spots += [(view, row, spot.pixel, spot.covariance) for spot in found.good]
        seen = LedSightings(
            np.array([spot[0] for spot in spots], dtype=np.intp),
            np.array([spot[1] for spot in spots], dtype=np.intp),
            np.array([spot[2] for spot in spots]).reshape(-1, 2),
            np.array([spot[3] for spot in spots]).reshape(-1, 2, 2),
            np.array(lit, dtype=np.intp),
        )
        views = tuple(str(number) for number in range(len(self.reported)))
        size_px = (self.camera["width_px"], self.camera["height_px"])
        about = About(simulated=True)
        return LedImages(
            seen, self.reported, views, size_px, (), about, (("rendered", "0" * 64),), self._joints_deg
        )

    @property
    def white_dn(self) -> int:
        return (1 << self.camera["bit_depth"]) - 1


# -- calibrated and judged --------------------------------------------------------------------------------


def prove_cell(seed: int, *, at: Postures, width_px: int, samples: int, absolute: bool) -> Proof:
    """Render, find, adjust, and compare what the records say with the truth."""
    cell = RandomCell(seed, width_px, samples, absolute)
    wish = Wish(f"cell{seed}", datetime.now(UTC))
    model: Arm | None = planning_arm(cell.cell.rig) if absolute else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        camera, hand_eye = _camera_and_hand_eye(cell, at, wish, model)
        write_record(folder / "hand-eye.yaml", hand_eye)
        prior = read_posed_camera(folder / "hand-eye.yaml", None, About(simulated=True), cell.size_px)
        arm = None if model is None else read_arm(folder / "hand-eye.yaml", model)
        proof = Proof([*_of_camera(cell, camera), *_of_hand_eye(cell, hand_eye)], {})
        _far(proof, "camera_mm", cell, *_camera_centres_mm(cell, at, prior, arm))
        _prove_leds(proof, cell, at, wish, prior, arm)
        _prove_mesh(proof, cell, at, wish, prior, arm, folder)
    return proof


def _far(proof: Proof, name: str, cell: RandomCell, found_mm: Floats, true_mm: Floats) -> None:
    """Median and largest distance of points [n, 3] in the base from where they are."""
    own = cell.own_base(np.eye(4))
    own_mm = true_mm @ own[:3, :3].T + own[:3, 3]
    for suffix, there_mm in (("", own_mm), ("_in_true_base", true_mm)):
        off_mm = np.linalg.norm(found_mm - there_mm, axis=1)
        proof.accuracy[f"{name}{suffix}"] = float(np.median(off_mm))
        proof.accuracy[f"{name}_worst{suffix}"] = float(off_mm.max())


def _camera_centres_mm(
    cell: RandomCell, at: Postures, prior: CameraPrior, arm: CalibratedArm | None
) -> tuple[Floats, Floats]:
    """Where the camera is at the board's postures, by the records and truly, but for the arm's repeatability."""
    poses = np.stack([flange_pose(joints) for joints in at.board])
    steady = replace(cell.arm_errors, repeatability_um=0.0, repeatability_deg=0.0)
    true = np.stack([steady.true_flange_pose(joints, 0) for joints in at.board]) @ cell.flange_from_camera
    if arm is not None:
        poses, prior = calibrated_poses(poses, at.board, arm, prior)
    return (poses @ prior.flange_from_camera)[:, :3, 3], true[:, :3, 3]


def _camera_and_hand_eye(cell: RandomCell, at: Postures, wish: Wish, model: Arm | None) -> tuple[Record, Record]:
    place = cell.place(0)
    thing = {"kind": "charuco_board", "square_mm": SQUARE_MM, "marker_mm": MARKER_MM, "thickness_mm": THICKNESS_MM}
    sources = Photographs(cell, at.board, 0, thing | place).sources()
    board = Board(
        kind="charuco", corners=(SQUARES[0] - 1, SQUARES[1] - 1), square_mm=SQUARE_MM, marker_mm=MARKER_MM
    )
    found = find_board(board, sources)
    off = (0.3, 0.02) if cell.absolute else (0.0, 1e-5)
    robot = RobotNoise(absolute_mm=off[0], absolute_deg=off[1])
    camera = camera_from(found, sources, "brown4", wish)[1].record
    return camera, hand_eye_from(found, sources, board, "brown4", wish, robot=robot, arm=model)[2].record


def _of_camera(cell: RandomCell, record: Record) -> Iterator[Judged]:
    for parameter in record.parameters:
        assert parameter.value is not None
        error = parameter.value - cell.true_lens[parameter.name]
        yield _judged(f"camera.{parameter.name}", error, parameter.u, parameter.degrees_of_freedom)


def _of_hand_eye(cell: RandomCell, record: Record) -> Iterator[Judged]:
    place = cell.place(0)
    corner_mm = (-0.5 * SQUARES[0] * SQUARE_MM, 0.5 * SQUARES[1] * SQUARE_MM, THICKNESS_MM)
    in_support = transform(place["translation_mm"], place["abc_deg"]) @ transform(corner_mm, (0.0, 0.0, 180.0))
    true = {
        "flange_from_camera": cell.flange_from_camera,
        "base_from_board": cell.own_base(cell.base_from_support @ in_support),
    }
    by_name = {parameter.name: parameter for parameter in record.parameters}
    for name, pose in record.transforms.items():
        found = transform(pose.translation_mm, pose.abc_deg)
        for step, error in zip(STEPS, _error(found, true[name]), strict=True):
            parameter = by_name[f"{name}.{step}"]
            yield _judged(parameter.name, error, parameter.u, parameter.degrees_of_freedom)


def _prove_leds(
    proof: Proof, cell: RandomCell, at: Postures, wish: Wish, prior: CameraPrior, arm: CalibratedArm | None
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
    stated = StatedOfLeds(tolerance_mm=0.05)
    found = leds_from(photographs.leds(table, lit), table, prior, wish, stated=stated, arm=arm).geometry
    row_of = {int(led): row for row, led in enumerate(truth.ids)}
    at_truth = [row_of[int(led)] for led in table.ids]
    own = cell.own_base(np.eye(4))
    true_mm = truth.positions_mm[at_truth] @ own[:3, :3].T + own[:3, 3]
    normals = truth.normals[at_truth] @ own[:3, :3].T
    _far(proof, "led_mm", cell, found.centres_mm, truth.positions_mm[at_truth])
    for led, covariance in enumerate(found.centre_covariance):
        u = np.sqrt(np.diag(covariance))
        for axis, error in enumerate(found.centres_mm[led] - true_mm[led]):
            proof.judged.append(_judged(f"leds.{'xyz'[axis]}_mm", error, u[axis]))
    tilts_deg = []
    for number, board in enumerate(np.unique(table.boards)):
        mine = int(np.flatnonzero(table.boards == board)[0])
        turned = found.state.base_from_board[number, :3, :3].T @ normals[mine]
        u = np.sqrt(np.diag(found.normal_covariance[number]))
        tilts_deg.append(float(np.degrees(np.linalg.norm(turned[:2]))))
        for axis, error in enumerate(np.degrees([-turned[1], turned[0]])):
            proof.judged.append(_judged(f"leds.normal_r{'xy'[axis]}_deg", float(error), u[axis]))
    proof.accuracy["led_normal_deg"] = float(np.median(tilts_deg))
    proof.accuracy["led_normal_deg_worst"] = max(tilts_deg)


def _prove_mesh(
    proof: Proof,
    cell: RandomCell,
    at: Postures,
    wish: Wish,
    prior: CameraPrior,
    arm: CalibratedArm | None,
    folder: Path,
) -> None:
    place = cell.place(1)
    thing = {"kind": "sculpted_relief", "stickers": {"count": STICKERS, "seed": cell.seed}} | place
    scan = _scanned(thing, cell.seed, folder)
    sources = Photographs(cell, at.mesh, 2000, thing).sources()
    depth_mm = (200.0, 900.0)
    images = find_all_stickers(sources, prior.lens, diameter_mm=STICKER_MM, depth_mm=depth_mm)
    stated = StatedOfMesh(scanner_mm=0.03, robot_mm=0.03, robot_deg=0.003)
    found = mesh_from(images, sources, scan, prior, wish, stated=stated, depth_mm=depth_mm, arm=arm).pose
    in_support = transform(place["translation_mm"], place["abc_deg"])
    true = cell.base_from_support @ in_support @ inverse(scanner_from_thing(cell.seed))
    u = np.sqrt(np.diag(found.covariance))
    for step, error, one in zip(STEPS, _error(found.base_from_mesh, cell.own_base(true)), u, strict=True):
        proof.judged.append(_judged(f"base_from_mesh.{step}", error, one))
    _far(proof, "mesh_mm", cell, apply(found.base_from_mesh, scan.targets_mm), apply(true, scan.targets_mm))


def _scanned(thing: dict[str, Any], seed: int, folder: Path) -> Scan:
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


def _error(found: Floats, true: Floats) -> Floats:
    """[6] of a transform: mm along the left frame's axes, degrees about the right one's."""
    turn = Rotation.from_matrix(true[:3, :3].T @ found[:3, :3]).as_rotvec(degrees=True)
    return np.array([*(found[:3, 3] - true[:3, 3]), *turn])


def _judged(name: str, error: float, u: float, degrees: float = np.inf) -> Judged:
    return Judged(name, float(error), float(u), float(coverage_factor(min(degrees, 1e9))) * float(u))

"""Are the intervals of a calibration true? Many random simulated cells, rendered, calibrated, held against truth.

    python tools/prove_calibrations.py --cells 100 [--width 1024] [--images 24] [--absolute] [--json]

Each cell has a lens, a hand-eye, a board and an arm of its own. Its frames are rendered as RAW pictures by `sim`,
found and adjusted by `coupole.calibration`, which share no code. One line for each parameter: how many of the
stated 95 % intervals hold the truth, and the root mean square of error over standard uncertainty, about 1.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

EXPOSURE_S = 0.008
SQUARES, SQUARE_MM, MARKER_MM, THICKNESS_MM = (12, 9), 16.0, 9.6, 4.0
FULL_WIDTH_PX, FULL_PITCH_UM = 4096, 5.5

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
class Verdict:
    """One parameter over all cells."""

    name: str
    cells: int
    covered: float
    rms_over_u: float
    median_error: float
    """Of its size, in the name's unit."""
    median_u: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--width", type=int, default=1024, help="of frames, px; 4096 is the real camera")
    parser.add_argument("--images", type=int, default=24)
    parser.add_argument("--samples", type=int, default=8, help="rays a pixel and direction")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--absolute", action="store_true", help="the arm is off by 0.3 mm and 0.02 deg as well")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    joints_deg = postures(arguments.images)
    prove = partial(
        prove_cell,
        joints_deg=joints_deg,
        width_px=arguments.width,
        samples=arguments.samples,
        absolute=arguments.absolute,
    )
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.cells)
    judged: list[list[Judged]] = []
    started_s = time.monotonic()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for cell in pool.map(prove, seeds):
            judged.append(cell)
            spent_s = time.monotonic() - started_s
            print(f"\r{len(judged)} of {len(seeds)} cells, {spent_s:.0f} s", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    for verdict in verdicts(judged):
        if arguments.json:
            print(json.dumps(asdict(verdict)))
        else:
            print(
                f"{verdict.name:32} covered {verdict.covered:6.1%}  rms(error/u) {verdict.rms_over_u:5.2f}  "
                f"median error {verdict.median_error:.3g}, u {verdict.median_u:.3g}"
            )


def verdicts(cells: list[list[Judged]]) -> list[Verdict]:
    """What the intervals are worth."""
    found = []
    for name in dict.fromkeys(one.name for cell in cells for one in cell):
        mine = [one for cell in cells for one in cell if one.name == name]
        error, u = np.array([one.error for one in mine]), np.array([one.u for one in mine])
        inside = np.abs(error) <= np.array([one.half_width for one in mine])
        found.append(
            Verdict(
                name,
                len(mine),
                float(inside.mean()),
                float(np.sqrt(np.mean((error / u) ** 2))),
                float(np.median(np.abs(error))),
                float(np.median(u)),
            )
        )
    return found


# -- one cell ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrueCell:
    """A random cell: what is true, as a world's configuration and as transforms."""

    config: dict[str, Any]
    flange_from_camera: Floats
    base_from_board: Floats
    reported: Floats
    """[n, 4, 4] base_from_flange as the robot believes it."""
    true: Floats
    focal_px: float
    distortion: tuple[float, ...]


def postures(count: int) -> Floats:
    """[count, 6] angles at which the camera sees the board as `coupole plan new charuco` wants it."""
    import tempfile

    from coupole.itinerary import plan_itinerary
    from coupole.job import read_job
    from coupole.templates import TEMPLATES

    with tempfile.TemporaryDirectory() as folder:
        plan = Path(folder) / "plan.yaml"
        plan.write_text(TEMPLATES["charuco"].format(name="prove", rig=ROOT / "configs/rigs/sim.yaml"))
        job = read_job(plan)
    itinerary = plan_itinerary(job.schedule.views, job.cell.rig, None, job.cell.rig.motion.home_joints_deg)
    angles = [visit.joints_deg for visit in itinerary.visits if visit is not None]
    return np.array(angles)[np.unique(np.linspace(0, len(angles) - 1, count).astype(int))]


def random_cell(seed: int, joints_deg: Floats, width_px: int, samples: int, *, absolute: bool) -> TrueCell:
    from coupole.cell import world_config
    from coupole.geometry import transform
    from coupole.job import read_cell
    from sim.kuka_kinematics import PoseErrors, flange_pose

    random = np.random.default_rng((seed, 77))
    cell = read_cell(ROOT / "configs/rigs/sim.yaml")
    pitch_um = FULL_PITCH_UM * FULL_WIDTH_PX / width_px
    sensor = cell.rig.sensor.model_copy(
        update={"width_px": width_px, "height_px": width_px * 3 // 4, "pixel_pitch_um": pitch_um}
    )
    config = world_config(cell, None, sensor)
    flange_from_camera = transform(
        np.array([0.0, 0.0, 120.0]) + random.normal(0.0, 2.0, 3), tuple(random.normal(0.0, 0.7, 3))
    )
    distortion = (float(random.normal(-0.03, 0.01)), 0.0, *map(float, random.normal(0.0, 1e-4, 2)), 0.0)
    focus_mm = float(random.uniform(330.0, 342.0))
    config["camera"] |= {"flange_from_camera": flange_from_camera.tolist(), "focus_distance_mm": focus_mm}
    place_mm, turn_deg = [*random.uniform(-8.0, 8.0, 2), 0.0], (float(random.uniform(-15.0, 15.0)), 0.0, 0.0)
    board = {
        "kind": "charuco_board",
        "square_mm": SQUARE_MM,
        "marker_mm": MARKER_MM,
        "thickness_mm": THICKNESS_MM,
        "translation_mm": place_mm,
        "abc_deg": turn_deg,
    }
    config["settings"] |= {"seed": seed, "things": [board], "arm_shadows": False}
    config["settings"]["camera"] = {"kind": "memory", "samples_per_side": samples, "distortion": distortion}
    corner_mm = (-0.5 * SQUARES[0] * SQUARE_MM, 0.5 * SQUARES[1] * SQUARE_MM, THICKNESS_MM)
    board_in_thing = transform(corner_mm, (0.0, 0.0, 180.0))
    base_from_support = cell.rig.support.base_from_support.matrix()
    errors = PoseErrors(seed, 30.0, 0.003, 0.3 if absolute else 0.0, 0.02 if absolute else 0.0)
    return TrueCell(
        config,
        flange_from_camera,
        base_from_support @ transform(place_mm, turn_deg) @ board_in_thing,
        np.stack([flange_pose(joints) for joints in joints_deg]),
        np.stack([errors.true_flange_pose(joints, stop) for stop, joints in enumerate(joints_deg)]),
        1e3 / pitch_um / (1.0 / cell.rig.lens.focal_length_mm - 1.0 / focus_mm),
        distortion,
    )


def prove_cell(seed: int, *, joints_deg: Floats, width_px: int, samples: int, absolute: bool) -> list[Judged]:
    """Render, find, adjust, and compare with the truth."""
    from coupole.calibration.arm_errors import axis_sensitivity
    from coupole.calibration.lens.board import Board, detect
    from coupole.calibration.lens.bundle import Poses, RobotNoise, calibrate_hand_eye
    from coupole.calibration.lens.camera import calibrate_camera, without_gross_errors
    from coupole.calibration.picture import Picture
    from coupole.job import read_cell
    from coupole.rig import planning_arm
    from sim.stills import Stills

    cell = random_cell(seed, joints_deg, width_px, samples, absolute=absolute)
    stills = Stills(cell.config)
    camera = cell.config["camera"]
    board = Board(
        kind="charuco", corners=(SQUARES[0] - 1, SQUARES[1] - 1), square_mm=SQUARE_MM, marker_mm=MARKER_MM
    )
    white = (1 << camera["bit_depth"]) - 1 - camera["black_dn"]
    sightings, chosen = [], []
    for number, pose in enumerate(cell.true):
        frame = stills.take(pose, leds=[], panels=[1], exposure_s=EXPOSURE_S).astype(np.float64)
        seen = detect(board, Picture(frame - camera["black_dn"], camera["bayer_pattern"], white, str(number)))
        if not isinstance(seen, str):
            sightings.append(seen)
            chosen.append(number)
    lens = calibrate_camera(sightings, (width_px, width_px * 3 // 4), "brown4")
    judged = [
        _judged(name, value, true, u, degrees)
        for name, value, true, u, degrees in zip(
            [f"camera.{name}" for name in lens.free],
            [getattr(lens.intrinsics, name) for name in lens.free],
            [_true_lens(cell, name, width_px) for name in lens.free],
            np.sqrt(np.diag(lens.covariance)),
            lens.degrees,
            strict=True,
        )
    ]
    arm = planning_arm(read_cell(ROOT / "configs/rigs/sim.yaml").rig) if absolute else None
    axes = axis_sensitivity(arm, [tuple(joints_deg[i]) for i in chosen]) if arm else None
    robot = RobotNoise(absolute_mm=0.3 if absolute else 0.0, absolute_deg=0.02 if absolute else 1e-5)
    found = calibrate_hand_eye(
        without_gross_errors(lens),
        Poses(cell.reported[chosen], axes),
        model="brown4",
        lens=lens.intrinsics,
        robot=robot,
    )
    for name in ("flange_from_camera",) if absolute else ("flange_from_camera", "base_from_board"):
        steps = _steps(getattr(found, name), getattr(cell, name))
        for step, error in zip(("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"), steps, strict=True):
            degrees = found.degrees[found.names.index(f"{name}.{step}")]
            judged.append(_judged(f"{name}.{step}", error, 0.0, found.u(f"{name}.{step}"), degrees))
    return judged


def _true_lens(cell: TrueCell, name: str, width_px: int) -> float:
    middle = {"cx": 0.5 * (width_px - 1), "cy": 0.5 * (width_px * 3 // 4 - 1)}
    bent = dict(zip(("k1", "k2", "p1", "p2", "k3"), cell.distortion, strict=True))
    return (middle | bent | {"fx": cell.focal_px, "fy": cell.focal_px})[name]


def _steps(found: Floats, true: Floats) -> Floats:
    """[6] error of a transform: mm along the left frame's axes, degrees about the right one's."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(true[:3, :3].T @ found[:3, :3]).as_rotvec(degrees=True)
    return np.array([*(found[:3, 3] - true[:3, 3]), *turn])


def _judged(name: str, value: float, true: float, u: float, degrees: float) -> Judged:
    from coupole.calibration.adjustment import coverage_factor

    return Judged(name, float(value - true), float(u), float(coverage_factor(degrees)) * float(u))


if __name__ == "__main__":
    main()

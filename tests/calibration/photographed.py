"""Runs and folders of pictures that show a board: what `coupole calibrate` is given."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from archives import METADATA
from boards import texture_of
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens, frame, looking_at_board, render

from coupole.calibration.lens.board import Board
from coupole.devices import ArmState, FrameFormat
from coupole.storage.frame_file_creation import create
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven, SessionStarted, SessionStopped
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.view_writer import ViewWriter

BOARD = Board(kind="charuco", corners=(9, 6), square_mm=16.0, marker_mm=10.0)
BOARD_YAML = "kind: charuco\ncorners: [9, 6]\nsquare_mm: 16.0\nmarker_mm: 10.0\n"
SIZE_PX = (480, 360)
LENS = TrueLens((800.0, 800.5), (241.3, 178.6), (0.04, -0.03, 0.0005, -0.0004, 0.0))
FORMAT = FrameFormat(
    height_px=SIZE_PX[1], width_px=SIZE_PX[0], bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095
)
FLANGE_FROM_CAMERA = frame(np.array([31.0, -42.0, 118.0]), np.array([4.0, -3.0, 60.0]))
ROBOT_MM, ROBOT_DEG = 0.03, 0.003


@dataclass(frozen=True)
class Shoot:
    """Pictures [H, W], 0 to 1, and the poses that the robot reports."""

    pictures: tuple[Array, ...]
    base_from_flange: tuple[Array, ...]


@cache
def shoot(count: int = 9, seed: int = 3) -> Shoot:
    """Views of the board from a camera that a robot carries."""
    random = np.random.default_rng(seed)
    texture, mm_per_texel = texture_of(BOARD)
    size_mm = np.array([10 * 16.0, 7 * 16.0])
    face_up = np.diag([1.0, -1.0, -1.0, 1.0])  # a printed board's z goes into it
    face_up[1, 3] = size_mm[1]
    base_from_board = frame(np.array([600.0, -50.0, 20.0]), np.array([2.0, 3.0, 40.0]))
    pictures, poses = [], []
    for _ in range(count):
        board_from_camera = face_up @ looking_at_board(random, size_mm, 330.0)
        pictures.append(render(LENS, SIZE_PX, np.linalg.inv(board_from_camera), texture, mm_per_texel))
        error = frame(random.normal(0, ROBOT_MM, 3), random.normal(0, ROBOT_DEG, 3))
        true = base_from_board @ board_from_camera @ np.linalg.inv(FLANGE_FROM_CAMERA)
        poses.append(true @ np.linalg.inv(error))
    return Shoot(tuple(pictures), tuple(poses))


def write_folder(
    folder: Path, made: Shoot | None = None, *, metres_said_mm: bool = False, radians_said_deg: bool = False
) -> Path:
    """Pictures of 8 bits, `poses.yaml` and `board.yaml`; in metres that are said to be mm, with Euler angles in
    radians that are said to be degrees, if so wanted."""
    import cv2

    folder.mkdir(parents=True)
    made = made or shoot()
    lines = ["schema_version: 1", f"length_unit: {'mm' if metres_said_mm else 'm'}"]
    lines += [f"angle_unit: {'deg' if radians_said_deg else 'rad'}"]
    lines += [f"rotation: {'abc' if radians_said_deg else 'rotation_vector'}", "poses:"]
    for number, (picture, pose) in enumerate(zip(made.pictures, made.base_from_flange, strict=True)):
        cv2.imwrite(str(folder / f"{number}.png"), np.rint(20 + 190 * picture).astype(np.uint8))
        turn = Rotation.from_matrix(pose[:3, :3])
        angles = turn.as_euler("ZYX") if radians_said_deg else turn.as_rotvec()
        numbers = [*(pose[:3, 3] / 1000), *angles]
        lines.append(f"  {number}.png: [{', '.join(f'{v:.9f}' for v in numbers)}]")
    (folder / "poses.yaml").write_text("\n".join(lines) + "\n")
    (folder / "board.yaml").write_text(BOARD_YAML)
    return folder


def write_run(
    folder: Path,
    made: Shoot | None = None,
    *,
    light: Sequence[float] | float = 0.8,
    room_c: float = 25.1,
    red_scale: float = 1.0,
) -> Run:
    """A run with two lit frames and a dark one in each view, some noise on all of them.

    `light` is that of each view's brighter frame; at 1.4 half of the board is white beyond the scale. Red pixels
    see all `red_scale` times as far from the lens's centre.
    """
    folder.mkdir(parents=True)
    for name in ("plan.yaml", "rig.yaml"):
        (folder / name).write_text(f"# {name}\n")
    made = made or shoot()
    lights = np.broadcast_to(light, len(made.pictures))
    views = [f"v{number}" for number in range(len(made.pictures))]
    labels = ["dark0/e0", "led0003/e0", "led0500/e0"]
    about = {"views": views, "labels": labels, "simulated": True}
    run = Run.create(folder, "board", Inputs(folder / "plan.yaml", folder / "rig.yaml", ()), about)
    diary, random = Journal(run.journal_path), np.random.default_rng(8)
    diary.write(SessionStarted())
    for view, picture, pose, bright in zip(views, made.pictures, made.base_from_flange, lights, strict=True):
        path = run.view_path(view)
        create(path, len(labels), FORMAT, {**METADATA, "title": view, "focus_distance_mm": 335.0})
        writer = ViewWriter(path, {})
        at = writer.add_pose(ArmState((0, -90, 90, 0, 90, 0), pose, 7, moving=False), pose @ FLANGE_FROM_CAMERA)
        coloured = _bayer(200 + 3000 * picture, red_scale)
        for number, label in enumerate(labels):
            share = 0.0 if label.startswith("dark") else bright * (1.0, 0.625)[number - 1]
            pixels = np.frombuffer(mmap.mmap(-1, FORMAT.frame_bytes), np.uint16).reshape(picture.shape)
            signal = 64 + share * coloured + random.normal(0, 6, picture.shape)
            pixels[:] = np.clip(np.rint(signal), 0, 4095)
            slot = writer.store(pixels, frame_id=number, camera_ns=number, exposure_us=8000)
            warmth = {"board_temperature_dc": round(10 * room_c), "led_current_ma": 700}
            digest = writer.prove(slot, f"{view}/{label}", led=number, pose=at, **warmth)
            file = str(path.relative_to(run.folder))
            diary.write(
                FrameProven(shot=f"{view}/{label}", file=file, index=slot, frame_id=number, xxh3=f"{digest:016x}")
            )
        writer.sync()
        writer.close()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.close()
    return run


def _bayer(picture: Array, red_scale: float) -> Array:
    """Each colour at a brightness of its own, GBRG."""
    from scipy.ndimage import affine_transform

    coloured = picture.copy()
    coloured[0::2, 1::2] *= 0.45
    red = picture
    if red_scale != 1.0:
        shift = np.array(LENS.centre_px[::-1]) * (1 - 1 / red_scale)
        red = affine_transform(picture, np.full(2, 1 / red_scale), shift, order=3, mode="nearest")
    coloured[1::2, 0::2] = 0.6 * red[1::2, 0::2]
    return coloured

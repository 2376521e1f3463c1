"""Speed of board detection and of adjustments, against plain use of OpenCV and scipy's sparse least squares.

The peers solve the same problem from the same start, by `least_squares` with the sparsity of its Jacobian and
numerical derivatives. They have no noise estimate and no covariance; Coupole's time includes both.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

LENS = np.array([7120.0, 7121.0, 2047.5, 1535.5, -0.05, 0.02, 2e-4, -3e-4, 0.0])
SIZE_PX = (4096, 3072)
PIXEL_PX, ROBOT_MM, ROBOT_DEG, TOLERANCE_MM = 0.05, 0.03, 0.003, 0.05


@dataclass(frozen=True)
class Size:
    """Size of the adjustments."""

    scale: float = 1.0
    """Scale of the image of a board, relative to 4096 x 3072 pixels."""
    images: int = 45
    boards: int = 180
    """Number of boards of six LEDs."""
    views: int = 150
    """Number of views of the dome."""
    peers_steps: int | None = None
    """Greatest number of steps of the peer; None: until it has converged."""


SMALLEST = Size(scale=0.25, images=8, boards=12, views=40, peers_steps=3)


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    size = SMALLEST if smallest else Size()
    yield _detection(rounds, size.scale)
    yield _bundle(rounds, size)
    yield _leds(rounds, size)


# -- boards in images -------------------------------------------------------------------------------------


def _detection(rounds: int, scale: float) -> dict[str, Any]:
    """One 12-megapixel image of a ChArUco board, including refinement of the corners in 12 bits."""
    import cv2

    from coupole.calibration.grey_image import Picture
    from coupole.calibration.lens.board import Board, detect

    board = Board(kind="charuco", corners=(11, 8), square_mm=16.0, marker_mm=12.0)
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    charuco_board = cv2.aruco.CharucoBoard((12, 9), 16.0, 12.0, markers)
    flat = charuco_board.generateImage((round(scale * 2880), round(scale * 2160)))
    turn = np.array([[0.9, -0.2, scale * 900.0], [0.18, 0.92, scale * 250.0]])
    width_px, height_px = (round(scale * side_px) for side_px in SIZE_PX)
    picture = cv2.warpAffine(flat, turn, (width_px, height_px), borderValue=128)
    image = np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.0), np.float64) * 14 + 100
    grey = np.asarray(np.clip(image / 16, 0, 255), np.uint8)

    def plain() -> Any:
        corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board).detectBoard(grey)
        return corners, ids

    return _compare_times(
        f"calibration_board_detection_{1e-6 * grey.size:.2g}mp",
        lambda: detect(board, Picture.of_grey(image, white=4095.0)),
        "opencv",
        plain,
        rounds,
    )


# -- adjustments ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scene:
    """Points [n, 3] on bodies, seen from poses of an arm."""

    places_mm: np.ndarray
    body_of: np.ndarray
    base_from_body: np.ndarray
    base_from_flange: np.ndarray
    """[v, 4, 4] as reported."""
    flange_from_camera: np.ndarray
    point: np.ndarray
    """[k] index of the point of each observation."""
    view: np.ndarray
    pixels: np.ndarray


def _scene(
    places_mm: Any, body_of: Any, base_from_body: Any, base_from_camera: Any, seed: int, off_mm: float = 0.0
) -> _Scene:
    """Observations of points on bodies, with noise of pixels, arm and positions."""
    random = np.random.default_rng(seed)
    flange_from_camera = _pose(np.array([31.0, -42.0, 118.0]), np.array([0.07, -0.05, 1.0]))
    poses = base_from_body[body_of]
    there_mm = places_mm + random.normal(0, 1, places_mm.shape) * off_mm
    in_base = np.einsum("nij,nj->ni", poses[:, :3, :3], there_mm) + poses[:, :3, 3]
    point, view, pixels = [], [], []
    for number, eye in enumerate(base_from_camera):
        there = (in_base - eye[:3, 3]) @ eye[:3, :3]
        front = np.flatnonzero(there[:, 2] > 100)
        image_points = _see(there[front], LENS)
        inside = ((image_points > 60) & (image_points < np.array(SIZE_PX) - 60)).all(axis=1)
        rows = front[inside]
        point.append(rows)
        view.append(np.full(len(rows), number))
        pixels.append(image_points[inside] + random.normal(0, PIXEL_PX, (len(rows), 2)))
    flanges = []
    for eye in base_from_camera:
        off = _pose(random.normal(0, ROBOT_MM, 3), np.radians(random.normal(0, ROBOT_DEG, 3)))
        flanges.append(eye @ np.linalg.inv(flange_from_camera) @ off)
    return _Scene(
        places_mm,
        body_of,
        base_from_body,
        np.array(flanges),
        flange_from_camera,
        np.concatenate(point),
        np.concatenate(view),
        np.concatenate(pixels),
    )


def _bundle(rounds: int, size: Size) -> dict[str, Any]:
    """Lens, hand-eye and board from images of 88 corners."""
    from coupole.calibration.lens.board import Sighting
    from coupole.calibration.lens.bundle import RobotNoise, calibrate_hand_eye
    from coupole.calibration.lens.equations import Poses
    from coupole.calibration.optics import Intrinsics

    random = np.random.default_rng(1)
    grid = np.array([(x, y, 0.0) for y in range(8) for x in range(11)]) * 16.0
    base_from_board = _pose(np.array([600.0, -50.0, 20.0]), np.array([0.03, 0.05, 0.7]))
    eyes = [base_from_board @ _towards(random, np.array([80.0, 56.0, 0.0]), 335.0) for _ in range(size.images)]
    scene = _scene(grid, np.zeros(len(grid), int), base_from_board[None], np.array(eyes), 2)
    sightings = [
        Sighting(
            f"image {v}",
            scene.point[scene.view == v],
            grid[scene.point[scene.view == v]],
            scene.pixels[scene.view == v],
        )
        for v in range(size.images)
    ]
    start, robot = Intrinsics(*LENS), RobotNoise(absolute_mm=0.0, absolute_deg=1e-5)

    def run_coupole() -> Any:
        return calibrate_hand_eye(sightings, Poses(scene.base_from_flange), lens=start, robot=robot)

    return _compare_times(
        f"calibration_bundle_{size.images}_images",
        run_coupole,
        "scipy",
        lambda: _plain(scene, False, size.peers_steps),
        rounds,
    )


def _leds(rounds: int, size: Size) -> dict[str, Any]:
    """LEDs on boards of six, each seen six times."""
    from coupole.calibration.leds.adjustment import adjust_leds
    from coupole.calibration.leds.boards import Boards
    from coupole.calibration.leds.equations import Stated, problem_of
    from coupole.calibration.leds.matching import LedSightings
    from coupole.calibration.optics import NAMES, Intrinsics
    from coupole.calibration.posed_camera import CameraPrior

    scene = _dome(size.boards, size.views)
    count = len(scene.places_mm)
    boards = Boards(np.arange(size.boards), scene.body_of, scene.base_from_body, scene.places_mm)
    sightings = LedSightings(
        scene.view,
        scene.point,
        scene.pixels,
        np.tile(PIXEL_PX**2 * np.eye(2), (len(scene.view), 1, 1)),
        np.stack([scene.view, scene.point], axis=1),
    )
    sigma = np.concatenate([[0.3, 0.3, 0.5, 0.5, 2e-4, 2e-3, 1e-5, 1e-5], np.full(3, 0.02), np.full(3, 4e-5)])
    prior = CameraPrior(Intrinsics(*LENS), NAMES[:8], scene.flange_from_camera, np.diag(sigma**2))

    def run_coupole() -> Any:
        stated_noise = Stated(tolerance_mm=TOLERANCE_MM)
        problem = problem_of(sightings, scene.point, boards, scene.base_from_flange, prior, stated_noise)
        return adjust_leds(problem, scene.base_from_body)

    figure = _compare_times(
        f"calibration_leds_{count}_x_6",
        run_coupole,
        "scipy",
        lambda: _plain(scene, True, size.peers_steps),
        rounds,
    )
    return {**figure, "leds": count, "spots": len(scene.view), "views": len(scene.base_from_flange)}


def _dome(boards: int, views: int) -> _Scene:
    """Boards of six on a sphere of 1.5 m; views from near its middle, until each LED has been seen six times."""
    random = np.random.default_rng(3)
    heights = 0.1 + 0.85 * (np.arange(boards) + 0.5) / boards
    around, ring = np.arange(boards) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - heights**2)
    outwards = np.stack([ring * np.cos(around), ring * np.sin(around), heights], axis=1)
    grid = np.array([(60.0 * (c - 1), 60.0 * (r - 0.5), 0.0) for r in range(2) for c in range(3)])
    poses = []
    for out in outwards:
        x = np.cross([0.0, 0.0, 1.0], out)
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3] = np.column_stack([x, np.cross(-out, x), -out, 1500 * out])
        poses.append(pose)
    eyes = []
    for number in range(views):
        z = outwards[(number * 2) % boards] + random.normal(0, 0.05, 3)
        z /= np.linalg.norm(z)
        x = np.cross(z, random.normal(size=3))
        x /= np.linalg.norm(x)
        eye = np.eye(4)
        eye[:3] = np.column_stack([x, np.cross(z, x), z, random.uniform(-400, 400, 3) - 300 * z])
        eyes.append(eye)
    scene = _scene(
        np.tile(grid, (boards, 1)),
        np.repeat(np.arange(boards), 6),
        np.array(poses),
        np.array(eyes),
        4,
        TOLERANCE_MM,
    )
    order = np.random.default_rng(5).permutation(len(scene.view))
    rank = np.zeros(len(order), int)
    counts = np.zeros(6 * boards, int)
    for row in order:
        rank[row] = counts[scene.point[row]]
        counts[scene.point[row]] += 1
    keep = np.flatnonzero(rank < 6)
    return _Scene(
        scene.places_mm,
        scene.body_of,
        scene.base_from_body,
        scene.base_from_flange,
        scene.flange_from_camera,
        scene.point[keep],
        scene.view[keep],
        scene.pixels[keep],
    )


# -- the peer ---------------------------------------------------------------------------------------------


def _plain(scene: _Scene, offsets: bool, steps: int | None) -> Any:
    """Solve for the same unknowns in scipy: bodies, views, hand-eye, eight parameters of the lens, and offsets of
    points if requested."""
    bodies, views, points = len(scene.base_from_body), len(scene.base_from_flange), len(scene.places_mm)
    at_view = 6 * bodies
    at_camera = at_view + 6 * views
    at_offset = at_camera + 14
    size = at_offset + (3 * points if offsets else 0)
    body_0, view_0 = _vectors(scene.base_from_body), _vectors(scene.base_from_flange)
    start = np.zeros(size)
    start[:at_view], start[at_view:at_camera] = body_0.ravel(), view_0.ravel()
    start[at_camera : at_camera + 6] = _vectors(scene.flange_from_camera[None])[0]
    start[at_camera + 6 : at_offset] = LENS[:8]
    body = scene.body_of[scene.point]
    scale = np.repeat([ROBOT_MM, np.radians(ROBOT_DEG)], 3)

    def residuals(x: Any) -> Any:
        of_bodies, of_views = x[:at_view].reshape(-1, 6), x[at_view:at_camera].reshape(-1, 6)
        places = scene.places_mm + (x[at_offset:].reshape(-1, 3) if offsets else 0.0)
        in_base = Rotation.from_rotvec(of_bodies[body, 3:]).apply(places[scene.point]) + of_bodies[body, :3]
        flange = of_views[scene.view]
        in_flange = Rotation.from_rotvec(flange[:, 3:]).inv().apply(in_base - flange[:, :3])
        hand_eye = x[at_camera : at_camera + 6]
        there = Rotation.from_rotvec(hand_eye[3:]).inv().apply(in_flange - hand_eye[:3])
        off = (_see(there, np.append(x[at_camera + 6 : at_offset], 0.0)) - scene.pixels) / PIXEL_PX
        parts = [off.ravel(), ((of_views - view_0) / scale).ravel()]
        return np.concatenate([*parts, x[at_offset:] / TOLERANCE_MM] if offsets else parts)

    rows = 2 * len(scene.view)
    pattern = lil_matrix((rows + 6 * views + (3 * points if offsets else 0), size), dtype=np.int8)
    for axis in range(2):
        row = 2 * np.arange(len(scene.view)) + axis
        for k in range(6):
            pattern[row, 6 * body + k] = 1
            pattern[row, at_view + 6 * scene.view + k] = 1
        if offsets:
            for k in range(3):
                pattern[row, at_offset + 3 * scene.point + k] = 1
        for k in range(14):
            pattern[row, at_camera + k] = 1
    poses = np.arange(6 * views)
    pattern[rows + poses, at_view + poses] = 1
    if offsets:
        coordinates = np.arange(3 * points)
        pattern[rows + 6 * views + coordinates, at_offset + coordinates] = 1
    return least_squares(
        residuals, start, jac_sparsity=pattern.tocsr(), x_scale="jac", method="trf", max_nfev=steps
    )


def _see(points: Any, lens: Any) -> Any:
    """Brown-Conrady model."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = fy * (y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    return np.stack([u, v], axis=1)


def _vectors(poses: Any) -> Any:
    """Translation and rotation vector [n, 6] of transforms [n, 4, 4]."""
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()], axis=1)


def _pose(translation_mm: Any, turn_rad: Any) -> Any:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn_rad).as_matrix(), translation_mm
    return pose


def _towards(random: np.random.Generator, target_mm: Any, distance_mm: float) -> Any:
    """Pose of a camera that looks down on a board, tilted by up to 40 degrees."""
    turn = Rotation.from_euler(
        "ZYZ", [random.uniform(0, 360), random.uniform(8, 40), random.uniform(0, 360)], degrees=True
    )
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = target_mm - distance_mm * random.uniform(0.9, 1.1) * pose[:3, 2]
    return pose


def _compare_times(
    name: str, run_coupole: Callable[[], Any], peer: str, run_peer: Callable[[], Any], rounds: int
) -> dict[str, Any]:
    seconds: dict[str, list[float]] = {"coupole": [], peer: []}
    for _ in range(rounds):
        for solver, work in (("coupole", run_coupole), (peer, run_peer)):
            started_s = time.perf_counter()
            work()
            seconds[solver].append(time.perf_counter() - started_s)
    ours_s, peer_s = statistics.median(seconds["coupole"]), statistics.median(seconds[peer])
    return {
        "name": name,
        "value": ours_s,
        "unit": "s",
        "peer": peer,
        "ratio": peer_s / ours_s,
        "peer_value": round(peer_s, 3),
    }

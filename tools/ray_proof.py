"""Compares records of camera and hand-eye with a cell whose form no record has: by rays, not by parameters.

A lens with terms that its record lacks has no true k1. But each direction has a true pixel, and the record states
an uncertainty of that pixel. Three kinds of results are compared: directions, up to a rotation of the camera
(which the lens alone does not determine); positions fixed to the flange; and pixels of the board in views that
were not taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from coupole.calibration import optics
from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.record import Record, intrinsics_of
from coupole.geometry import inverse, transform
from random_cells import SQUARE_MM, SQUARES, THICKNESS_MM, Floats, RandomCell
from sim.devices.kuka_kinematics import flange_pose
from sim.render.lens import Lens, distorted_points
from sim.strangers.lens_stranger import TAPS

ARM_STRANGERS = ("backlash", "sag", "ripple")
LENS_STRANGERS = ("rational", "prism", "stop", "breathing", "coma")
LIGHT_STRANGERS = ("lobe", "dies", "primary")
_FIELD = (-0.9, -0.45, 0.0, 0.45, 0.9)
"""Positions in the field, relative to half its width and height."""
_DISTANCE_MM = 335.0
_COMA_CENTROID = float(np.average(np.arange(TAPS) + 0.5, weights=TAPS - (np.arange(TAPS) + 0.5)) / TAPS)
"""Distance of a comatic spot's centroid from its bright end, relative to the spot's length."""
_NEW_STOPS = 5000
_NEW_VIEWS = 6
Vector = tuple[str, float, float, float]
"""Name, error, standard uncertainty, half width of the 95 % interval."""


def true_lens(cell: RandomCell, down: float) -> Lens:
    """Return the lens as rendered, when the cosine between the camera's direction and straight down is `down`."""
    width_px, height_px = cell.size_px
    strange = cell.strangers.lens
    focal_px = cell.true_lens["fx_px"]
    distortion = (cell.lens["k1"] + strange.rational[0], 0.0, cell.lens["p1"], cell.lens["p2"], 0.0)
    plain = Lens(width_px, height_px, focal_px, distortion)
    return strange.with_breathing(strange.disturbed_lens(plain, cell.lens["focus_mm"]), down)


def true_pixels(cell: RandomCell, in_camera_mm: Floats, down: float) -> Floats:
    """[n, 2] pixels at which points [n, 3] of the camera frame are seen; with coma, the centroids of their
    spots."""
    lens = true_lens(cell, down)
    at = distorted_points(in_camera_mm[:, :2] / in_camera_mm[:, 2:], lens.terms) * lens.focal_px + lens.centre_px
    return at + _COMA_CENTROID * cell.strangers.lens.coma_shift_px(at, cell.size_px)


def judged_rays(cell: RandomCell, camera: Record, hand_eye: Record, joints_deg: Floats) -> Iterator[Vector]:
    """Yield the errors of rays by both records. `joints_deg` [n, 6] are those of the calibration's views."""
    down = _mean_down(cell, joints_deg)
    field = _field_mm(cell)
    true_px = true_pixels(cell, field, down)
    lens, free = intrinsics_of(camera)
    at = [optics.NAMES.index(name) for name in free]

    def pixels_by_lens(step: Floats) -> Floats:
        vector = lens.vector()
        vector[at] += step
        return optics.project(field, vector).pixels

    turns = _derivatives(lambda step: optics.project(field @ _turn(step).T, lens.vector()).pixels, 3, 1e-6)
    without = np.eye(len(turns)) - turns @ np.linalg.pinv(turns)
    yield from _judge_pixels("camera.ray_px", camera, pixels_by_lens, true_px, without)
    if cell.stranger in ARM_STRANGERS:
        yield from _judged_views(cell, hand_eye, joints_deg)
        return
    in_flange = field @ cell.flange_from_camera[:3, :3].T + cell.flange_from_camera[:3, 3]
    yield from _judge_pixels(
        "hand-eye.ray_px", hand_eye, lambda step: _by_hand_eye(hand_eye, step, in_flange), true_px
    )


def has_truth(cell: RandomCell, parameter: str) -> bool:
    """Tell whether a hand-eye record's parameter has a true value in a cell with a stranger.

    With another form of lens, the camera's rotation depends on the definition of its axis. An arm whose error
    depends on the posture has no unique flange, and a bent board has no unique plane.
    """
    if cell.stranger in ARM_STRANGERS or parameter.startswith("base_from_board"):
        return False
    return cell.stranger not in LENS_STRANGERS or parameter.endswith("_mm")


def _judge_pixels(
    name: str, record: Record, pixels: Callable[[Floats], Floats], seen_px: Floats, keep: Floats | None = None
) -> Iterator[Vector]:
    """Compare pixels [n, 2], which `pixels` computes after a step of the record's parameters; `keep` [2 n, 2 n] is
    a projection."""
    covariance = record.covariance_matrix
    by = _derivatives(pixels, len(covariance), 1e-3 * np.sqrt(np.diag(covariance)))
    off = (pixels(np.zeros(len(covariance))) - seen_px).ravel()
    if keep is not None:
        by, off = keep @ by, keep @ off
    u = np.sqrt(np.einsum("ki,ij,kj->k", by, covariance, by))
    k = float(coverage_factor(_degrees(record)))
    yield from ((name, float(e), float(s), k * float(s)) for e, s in zip(off, u, strict=True))


def _judged_views(cell: RandomCell, record: Record, joints_deg: Floats) -> Iterator[Vector]:
    """Compare corners of the board in views between those of the calibration; the noise of a stop is as
    recorded."""
    noise = {noise_term.name: noise_term.found for noise_term in record.noise}
    stop = np.array([noise["robot position"]] * 3 + [np.radians(noise["robot orientation"])] * 3)
    steps = np.linspace(0, len(joints_deg) - 2, _NEW_VIEWS).astype(int)
    count = len(record.parameters)
    sizes = np.concatenate([1e-3 * np.sqrt(np.diag(record.covariance_matrix)), 1e-3 * stop])
    covariance = np.zeros((count + 6, count + 6))
    covariance[:count, :count] = record.covariance_matrix
    covariance[count:, count:] = np.diag(stop**2)
    k = float(coverage_factor(_degrees(record)))
    corners = SQUARE_MM * np.array([(i, j, 0.0) for i in (0, 5, 10) for j in (0, 3, 7)])
    for number, first in enumerate(steps):
        joints = 0.5 * (joints_deg[first] + joints_deg[first + 1])
        reported_pose = flange_pose(joints.tolist())
        true = cell.arm_errors.true_flange_pose(joints, _NEW_STOPS + number, joints_deg[first])
        in_camera = _board_points(corners, true_board(cell), true @ cell.flange_from_camera)
        true_px = true_pixels(cell, in_camera, 1.0)

        def pixels(step: Floats, reported: Floats = reported_pose) -> Floats:
            at_stop = reported @ _moved_pose(np.eye(4), step[count:])
            return _of_board(record, step[:count], at_stop, corners)

        off = (pixels(np.zeros(count + 6)) - true_px).ravel()
        by = _derivatives(pixels, count + 6, sizes)
        u = np.sqrt(np.einsum("ki,ij,kj->k", by, covariance, by))
        for e, s in zip(off, u, strict=True):
            yield "hand-eye.view_px", float(e), float(s), k * float(s)


def true_board(cell: RandomCell) -> Floats:
    """`base_from_board` of the first inner corner's frame."""
    place = cell.place(0)
    corner_mm = (-0.5 * SQUARES[0] * SQUARE_MM, 0.5 * SQUARES[1] * SQUARE_MM, THICKNESS_MM)
    in_support = transform(place["translation_mm"], place["abc_deg"]) @ transform(corner_mm, (0.0, 0.0, 180.0))
    return np.asarray(cell.base_from_support @ in_support)


# -- what a record says ---------------------------------------------------------------------------------------


def _by_hand_eye(record: Record, step: Floats, in_flange_mm: Floats) -> Floats:
    lens, camera, _ = _after_step(record, step)
    flange_in_camera = inverse(camera)
    return optics.project(in_flange_mm @ flange_in_camera[:3, :3].T + flange_in_camera[:3, 3], lens).pixels


def _of_board(record: Record, step: Floats, base_from_flange: Floats, corners_mm: Floats) -> Floats:
    lens, camera, board = _after_step(record, step)
    return optics.project(_board_points(corners_mm, board, base_from_flange @ camera), lens).pixels


def _after_step(record: Record, step: Floats) -> tuple[Floats, Floats, Floats]:
    """Lens [9], flange_from_camera and base_from_board after a step of the record's parameters."""
    lens, free = intrinsics_of(record)
    vector, names = lens.vector(), [parameter.name for parameter in record.parameters]
    vector[[optics.NAMES.index(name) for name in free]] += step[: len(free)]
    poses = []
    for name in ("flange_from_camera", "base_from_board"):
        first = names.index(f"{name}.x_mm")
        pose_step = step[first : first + 6].copy()
        pose_step[3:] = np.radians(pose_step[3:])
        pose = record.transforms[name]
        poses.append(_moved_pose(transform(pose.translation_mm, pose.abc_deg), pose_step))
    return vector, poses[0], poses[1]


def _moved_pose(pose: Floats, step: Floats) -> Floats:
    """Shifted along the left frame's axes, turned about the right one's: as records state uncertainty."""
    moved_pose = pose.copy()
    moved_pose[:3, 3] += step[:3]
    moved_pose[:3, :3] = pose[:3, :3] @ _turn(step[3:])
    return moved_pose


def _turn(vector: Floats) -> Floats:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _board_points(corners_mm: Floats, base_from_board: Floats, base_from_camera: Floats) -> Floats:
    pose = inverse(base_from_camera) @ base_from_board
    return np.asarray(corners_mm @ pose[:3, :3].T + pose[:3, 3])


def _derivatives(pixels: Callable[[Floats], Floats], count: int, size: float | Floats) -> Floats:
    """Return [2 n, count] by central differences."""
    sizes = np.broadcast_to(size, (count,))
    columns = []
    for direction, width in zip(np.eye(count), sizes, strict=True):
        columns.append((pixels(direction * width) - pixels(-direction * width)).ravel() / (2 * width))
    return np.stack(columns, axis=1)


def _degrees(record: Record) -> float:
    """Return the least number of degrees of freedom of all parameters."""
    return min([1e9, *(parameter.degrees_of_freedom for parameter in record.parameters)])


def _field_mm(cell: RandomCell) -> Floats:
    """[25, 3] points over the field in the camera frame."""
    width_px, height_px = cell.size_px
    focal_px = cell.true_lens["fx_px"]
    x, y = np.meshgrid(0.5 * width_px * np.array(_FIELD), 0.5 * height_px * np.array(_FIELD))
    points = np.stack([x.ravel() / focal_px, y.ravel() / focal_px, np.ones(x.size)], axis=1)
    return np.asarray(_DISTANCE_MM * points)


def _mean_down(cell: RandomCell, joints_deg: Floats) -> float:
    """Return the cosine between the camera's axis and straight down, as mean of the views."""
    up = cell.base_from_support[:3, 2]
    axes = np.stack([flange_pose(joints) @ cell.flange_from_camera for joints in joints_deg.tolist()])[:, :3, 2]
    return float(np.mean(-axes @ up))

"""Deviations of a rig's geometry, from sights of one board in several postures. Pure geometry: no devices are
used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.optics import Intrinsics, project
from coupole.geometry import Transform, inverse

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sight:
    """The board, seen once."""

    support_from_camera: Transform
    """Pose of the camera by the rig, from the measured axes."""
    board_mm: Floats
    """[n, 3] the corners that the camera sees, in the board's frame."""
    pixels: Floats
    """[n, 2] where the camera sees these corners."""


@dataclass(frozen=True)
class Deviations:
    """Pose of the board by all sights together, minus the pose that the rig gives; support frame."""

    height_mm: float
    """Height of the board's middle. It is positive if the camera sees the board higher."""
    sideways_mm: float
    tilt_deg: float
    """Tilt of the board against the disk."""
    disagreement_mm: float
    """Disagreement of the worst sight: root mean square distance on the board between its corners as seen and as
    predicted by all sights together. It shows errors of the camera's place on the flange, of its lens and of the
    arm."""
    cause: str
    """The one error that explains the sights best, in words."""


def deviations(
    sights: Sequence[Sight], intrinsics: Intrinsics, middle_mm: Floats, expected_mm: Floats, start: Transform
) -> Deviations:
    """Return the deviations. `middle_mm` [3] is the board's middle in its own frame, `expected_mm` [3] the same in
    the support frame. `start` is a first `support_from_board`."""
    sees = _Model(sights, intrinsics)
    free = _least_squares_fit(lambda x: sees.residuals_mm(_pose_after(start, x), np.zeros(3)), 6)
    support_from_board = _pose_after(start, free)
    off_mm = support_from_board[:3, :3] @ middle_mm + support_from_board[:3, 3] - expected_mm
    # If the camera alone is wrong, the board lies flat where it was measured; how it is turned there is not known.
    flat = _laid_flat(support_from_board, middle_mm, expected_mm)
    shift_and_turn = _least_squares_fit(
        lambda x: sees.residuals_mm(_pose_turned_about(flat, expected_mm, x[3]), x[:3]), 4
    )
    left_free = sees.residuals_mm(support_from_board, np.zeros(3))
    left_shifted = sees.residuals_mm(_pose_turned_about(flat, expected_mm, shift_and_turn[3]), shift_and_turn[:3])
    ends = np.cumsum([2 * len(sight.pixels) for sight in sights])[:-1]
    worst_mm = max(float(np.sqrt(2.0 * np.mean(part**2))) for part in np.split(left_free, ends))
    return Deviations(
        height_mm=float(off_mm[2]),
        sideways_mm=float(np.hypot(*off_mm[:2])),
        tilt_deg=float(np.degrees(np.arccos(np.clip(abs(support_from_board[2, 2]), 0.0, 1.0)))),
        disagreement_mm=worst_mm,
        cause=_cause(off_mm, shift_and_turn[:3], np.linalg.norm(left_free) <= np.linalg.norm(left_shifted)),
    )


class _Model:
    def __init__(self, sights: Sequence[Sight], intrinsics: Intrinsics) -> None:
        self._sights, self._intrinsics = sights, intrinsics

    def residuals_mm(self, support_from_board: Transform, camera_shift_mm: Floats) -> Floats:
        """Return [2 corners] predicted minus seen, as lengths at the board's distance. The projection centre is
        shifted in the camera frame."""
        residuals = []
        for sight in self._sights:
            camera_from_board = inverse(sight.support_from_camera) @ support_from_board
            points = sight.board_mm @ camera_from_board[:3, :3].T + camera_from_board[:3, 3] - camera_shift_mm
            off_px = project(points, self._intrinsics.vector()).pixels - sight.pixels
            residuals.append((off_px * points[:, 2:] / self._intrinsics.fx).ravel())
        return np.concatenate(residuals)


def _least_squares_fit(residuals: Callable[[Floats], Floats], count: int) -> Floats:
    from scipy.optimize import least_squares

    return np.asarray(least_squares(residuals, np.zeros(count), x_scale="jac").x, dtype=np.float64)


def _pose_after(start: Transform, change: Floats) -> Transform:
    from scipy.spatial.transform import Rotation

    pose = start.copy()
    pose[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ start[:3, :3]
    pose[:3, 3] = start[:3, 3] + 100.0 * change[3:]  # as large as turns, for the fit
    return pose


def _laid_flat(support_from_board: Transform, middle_mm: Floats, at_mm: Floats) -> Transform:
    """Return the pose of a board that lies flat on the disk, with its middle at a point."""
    pose = np.eye(4)
    along = np.array([*support_from_board[:2, 0], 0.0])
    up = np.array([0.0, 0.0, 1.0 if support_from_board[2, 2] > 0 else -1.0])
    along /= np.linalg.norm(along)
    pose[:3, :3] = np.column_stack([along, np.cross(up, along), up])
    pose[:3, 3] = at_mm - pose[:3, :3] @ middle_mm
    return pose


def _pose_turned_about(flat: Transform, about_mm: Floats, angle_rad: float) -> Transform:
    turn = np.eye(4)
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
    turn[:3, 3] = about_mm - turn[:3, :3] @ about_mm
    return np.asarray(turn @ flat)


def _cause(off_mm: Floats, camera_mm: Floats, sights_agree: bool) -> str:
    if sights_agree:
        way = "higher" if off_mm[2] > 0 else "lower"
        return f"the sights agree with a support that is {abs(off_mm[2]):.0f} mm {way} than the rig says"
    way = "farther from the flange" if camera_mm[2] > 0 else "nearer to the flange"
    return (
        f"the sights agree with a camera whose projection centre is {abs(camera_mm[2]):.0f} mm {way}, along its "
        "axis, than the rig's `flange_from_camera` says"
    )

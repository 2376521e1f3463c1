"""Intrinsics and distortion from images of a board, with covariance.

OpenCV's calibration (Zhang) gives the initial values. One adjustment of all images follows, in which corners with
gross errors are left out and the noise of the others is estimated from their residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coupole.calibration import optics
from coupole.calibration.adjustment import Adjusted, Block, Group, adjust
from coupole.calibration.lens.board import Sighting
from coupole.calibration.lens.corners import PIXEL_SIGMA_PX, Corners
from coupole.calibration.lens.doubts import Doubts, Seen, doubts_of
from coupole.calibration.lens.suspects import Field
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats, moved_transforms, rotation, skew
from coupole.errors import InputError

LEAST_VIEWS, MOST_VIEWS = 4, 400
_START_VIEWS = 20


@dataclass(frozen=True)
class CameraState:
    """The unknowns: intrinsics [9] and `camera_from_board` [views, 4, 4]."""

    intrinsics: Floats
    camera_from_board: Floats


@dataclass(frozen=True)
class CameraCalibration:
    """A camera with the uncertainty of its parameters, and the residuals of each image."""

    intrinsics: Intrinsics
    free: tuple[str, ...]
    covariance: Floats
    """[free, free] covariance of the free parameters, in their order."""
    degrees: Floats
    """[free] effective degrees of freedom."""
    sigma_px: float
    """Estimated noise of a corner, per coordinate."""
    camera_from_board: Floats
    """[views, 4, 4]."""
    residuals_px: tuple[Floats, ...]
    """[n, 2] residuals of each image, observed minus computed."""
    accepted_masks: tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], ...]
    """[n] mask of each image: False for corners that were left out as gross errors."""
    sightings: tuple[Sighting, ...]
    size_px: tuple[int, int]
    """Width and height."""
    doubts: Doubts | None = None
    """Possible errors of the model, already included in values and covariance; None if they were not requested."""


def calibrate_camera(
    sightings: Sequence[Sighting], size_px: tuple[int, int], model: str = "brown5", *, with_doubts: bool = False
) -> CameraCalibration:
    """Estimate intrinsics from images [views] of one board. `model` is a key of `optics.MODELS`. With
    `with_doubts`, the residuals are searched for errors of the model (`lens.doubts`).

    Raises InputError for too few images, or views that do not determine the model.
    """
    if not LEAST_VIEWS <= len(sightings) <= MOST_VIEWS:
        raise InputError(
            f"camera: {len(sightings)} usable images of the board, expected {LEAST_VIEWS} to {MOST_VIEWS} "
            "(40 to 60 are good). Take more, tilted by 20 to 45 degrees, the board in all corners of the field."
        )
    free = optics.MODELS[model]
    start = first_guess(sightings, size_px, model)
    corners = Corners.of(sightings)
    columns = [optics.NAMES.index(name) for name in free]
    free_count = len(free)

    def evaluate(state: CameraState) -> list[Block]:
        projection = optics.project(corners.in_camera(state.camera_from_board), state.intrinsics)
        by_turn = state.camera_from_board[corners.view, :3, :3] @ skew(corners.board_mm)
        by_pose = np.concatenate([projection.by_point, -projection.by_point @ by_turn], axis=-1)
        jacobian = np.concatenate([projection.by_intrinsics[:, :, columns], by_pose], axis=-1) / PIXEL_SIGMA_PX
        residuals = (corners.pixels - projection.pixels) / PIXEL_SIGMA_PX
        return [
            Block(
                residuals[part].ravel(),
                jacobian[part].reshape(-1, free_count + 6),
                np.r_[0:free_count, free_count + 6 * view : free_count + 6 * view + 6],
                0,
            )
            for view, part in enumerate(corners.parts)
        ]

    def move(state: CameraState, change: Floats) -> CameraState:
        intrinsics = state.intrinsics.copy()
        intrinsics[columns] += change[:free_count]
        return CameraState(
            intrinsics, moved_transforms(state.camera_from_board, change[free_count:].reshape(-1, 6))
        )

    groups = [Group("corners", is_estimated=True, rejects=2)]
    adjustment = adjust(start, evaluate, move, groups, free_count + 6 * len(sightings), calibration_name="camera")
    if not with_doubts:
        return _result(adjustment, free, sightings, size_px)
    state = adjustment.state
    field = Field.of(state.intrinsics, free, size_px)
    scene = Seen(field, corners, state.camera_from_board)
    views = [[view] for view in range(len(sightings))]
    doubts, step, covariance = doubts_of(adjustment, evaluate(state), views, scene, range(free_count))
    better = replace(adjustment, state=move(state, step), covariance=covariance)
    result = _result(better, free, sightings, size_px)
    return replace(result, sigma_px=doubts.sigma_px, doubts=doubts)


def _result(
    adjustment: Adjusted[CameraState],
    free: tuple[str, ...],
    sightings: Sequence[Sighting],
    size_px: tuple[int, int],
) -> CameraCalibration:
    free_count = len(free)
    intrinsics = Intrinsics(*map(float, adjustment.state.intrinsics))
    return CameraCalibration(
        intrinsics,
        free,
        adjustment.covariance[:free_count, :free_count],
        adjustment.degrees[:free_count],
        PIXEL_SIGMA_PX * adjustment.factor("corners"),
        adjustment.state.camera_from_board,
        tuple(PIXEL_SIGMA_PX * residuals.reshape(-1, 2) for residuals in adjustment.residuals),
        tuple(keep.reshape(-1, 2)[:, 0] for keep in adjustment.accepted_masks),
        tuple(sightings),
        size_px,
    )


def first_guess(sightings: Sequence[Sighting], size_px: tuple[int, int], model: str) -> CameraState:
    """Return OpenCV's calibration from up to 20 images (Zhang, PAMI 22(11), 2000), and the poses of all images
    with it."""
    import cv2

    start_sightings = [
        sightings[i] for i in np.unique(np.linspace(0, len(sightings) - 1, _START_VIEWS).astype(int))
    ]
    flags_of = {
        "pinhole": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        "radial": cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        "brown4": cv2.CALIB_FIX_K3,
        "brown5": 0,
    }
    try:
        _, matrix, distortion, *_ = cv2.calibrateCameraExtended(
            [sighting.board_mm.astype(np.float32) for sighting in start_sightings],
            [sighting.pixels.astype(np.float32) for sighting in start_sightings],
            size_px,
            np.eye(3),
            np.zeros(5),
            flags=flags_of[model],
        )
    except cv2.error as error:
        raise InputError(
            f"camera: OpenCV finds no first solution ({error.err}). Take views that differ in tilt and roll."
        ) from error
    vector = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(distortion)[:5]])
    intrinsics = Intrinsics(*map(float, vector))
    return CameraState(vector, np.stack([board_pose(sighting, intrinsics) for sighting in sightings]))


def board_pose(sighting: Sighting, intrinsics: Intrinsics) -> Floats:
    """Return `camera_from_board` from one image with known intrinsics. Raises InputError if no pose is found."""
    import cv2

    is_solved, turn, shift = cv2.solvePnP(
        sighting.board_mm, sighting.pixels, intrinsics.matrix(), intrinsics.distortion()
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(np.ravel(turn)), np.ravel(shift)
    in_front = (sighting.board_mm @ pose[:3, :3].T + pose[:3, 3])[:, 2] > 0
    if not is_solved or not in_front.all():
        raise InputError(f"{sighting.name}: no pose of the board fits its corners. Leave this image out.")
    return pose


def without_gross_errors(calibration: CameraCalibration) -> tuple[Sighting, ...]:
    """Return the sightings without the corners that were left out."""
    return tuple(
        replace(
            sighting,
            ids=sighting.ids[keep],
            board_mm=sighting.board_mm[keep],
            pixels=sighting.pixels[keep],
            u_px=None if sighting.u_px is None else sighting.u_px[keep],
        )
        for sighting, keep in zip(calibration.sightings, calibration.accepted_masks, strict=True)
    )

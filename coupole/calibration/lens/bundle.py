"""Camera, hand-eye, board and the robot's errors in one adjustment (its equations: `lens.equations`).

Corners, positions and orientations of the robot each have a noise that is estimated from their residuals. The zero
errors of the axes and the error of the board's scale have priors with the stated standard deviations.

Two errors cannot be determined from such images, and are not needed. A constant error of the base becomes part of
base_from_board, and a constant error of the flange becomes part of flange_from_camera. Both are used only in a
product with reported poses, in which they cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coupole.calibration import optics
from coupole.calibration.adjustment import Adjusted, Component, adjust
from coupole.calibration.lens.board import Sighting
from coupole.calibration.lens.camera import board_pose
from coupole.calibration.lens.corners import PIXEL_SIGMA_PX, Corners
from coupole.calibration.lens.doubts import Doubts, Seen, doubts_of
from coupole.calibration.lens.equations import (
    CORNERS,
    ORIENTATION,
    POSITION,
    Bundle,
    EarlierLens,
    Layout,
    Poses,
    State,
)
from coupole.calibration.lens.hand_eye import Solution, solve
from coupole.calibration.lens.suspects import Field
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats, rotation_vector
from coupole.errors import InputError

_LEAST_SIGMA_MM, _LEAST_SIGMA_RAD = 1e-3, 1e-6


@dataclass(frozen=True)
class RobotNoise:
    """Stated noise of a robot: standard deviations of each coordinate."""

    repeatability_mm: float = 0.03
    repeatability_deg: float = 0.003
    absolute_mm: float = 0.3
    """Absolute error in addition to repeatability. It is not used if axes are known, because their zeros are then
    estimated."""
    absolute_deg: float = 0.02
    """Absolute error of orientation. If axes are known, it is the error of each axis zero."""

    def pose_sigmas(self, *, axes_known: bool) -> tuple[float, float]:
        """Return the stated noise of one pose: mm, radians."""
        if axes_known:
            return self.repeatability_mm, float(np.radians(self.repeatability_deg))
        return (
            float(np.hypot(self.repeatability_mm, self.absolute_mm)),
            float(np.radians(np.hypot(self.repeatability_deg, self.absolute_deg))),
        )


@dataclass(frozen=True)
class HandEyeCalibration:
    """Hand-eye and everything that was estimated with it."""

    flange_from_camera: Floats
    base_from_board: Floats
    intrinsics: Intrinsics
    names: tuple[str, ...]
    """[s] names of the parameters that all images share, with units."""
    covariance: Floats
    """[s, s] in these units, marginalised over the errors of the poses."""
    degrees: Floats
    """[s] effective degrees of freedom."""
    shares: Floats
    """[groups, s] contribution of each group to each parameter's variance."""
    components: tuple[Component, ...]
    """[groups]."""
    board_scale: float
    """Relative excess of the board's size, compared with its description."""
    axis_zeros_deg: Floats
    """[axes] true minus reported angles; empty if axes were not known."""
    pose_errors: Floats
    """[n, 6] errors of each pose in the flange's frame, mm and degrees."""
    residuals_px: tuple[Floats, ...]
    """[k, 2] residuals of each image, observed minus computed."""
    start: Solution
    """Park's solution, from which the adjustment started."""
    noise: RobotFound
    sightings: tuple[Sighting, ...]
    steps: int
    doubts: Doubts | None = None
    """Possible errors of the model, already included in values and covariance; None if they were not requested."""

    def u(self, name: str) -> float:
        """Standard uncertainty of a parameter."""
        at = self.names.index(name)
        return float(np.sqrt(self.covariance[at, at]))


@dataclass(frozen=True)
class RobotFound:
    """Estimated and stated noise of the robot."""

    pixel_px: float
    position_mm: float
    orientation_deg: float
    stated_position_mm: float
    stated_orientation_deg: float


def calibrate_hand_eye(
    sightings: Sequence[Sighting],
    poses: Poses,
    *,
    model: str = "brown5",
    lens: Intrinsics | EarlierLens,
    robot: RobotNoise,
    board_scale_u_ppm: float = 0.0,
    size_px: tuple[int, int] | None = None,
) -> HandEyeCalibration:
    """Estimate hand-eye, board and intrinsics from images [n] and the robot's poses.

    `lens` is a start for the intrinsics (all parameters of `model` free), or an earlier calibration, whose
    covariance then counts as an observation. `sightings` are without gross errors (`camera.without_gross_errors`).
    With `size_px`, width and height of the images, the residuals are searched for errors of the model
    (`lens.doubts`). Raises InputError for too few poses, or poses that do not determine the result.
    """
    if len(sightings) != len(poses.base_from_flange):
        raise InputError(
            f"hand-eye: {len(sightings)} images and {len(poses.base_from_flange)} poses; expected "
            f"one pose for each image"
        )
    earlier = lens if isinstance(lens, EarlierLens) else None
    intrinsics = earlier.intrinsics if earlier else lens
    assert isinstance(intrinsics, Intrinsics)
    free = earlier.free if earlier else optics.MODELS[model]
    seen_poses = np.stack([board_pose(sighting, intrinsics) for sighting in sightings])
    start = solve(poses.base_from_flange, seen_poses)
    axes = 0 if poses.axis_sensitivity is None else poses.axis_sensitivity.shape[2]
    stated_sigmas = robot.pose_sigmas(axes_known=axes > 0)
    sigmas = (
        max(stated_sigmas[0], start.scatter_mm / 3**0.5, _LEAST_SIGMA_MM),
        max(stated_sigmas[1], float(np.radians(start.scatter_deg)) / 3**0.5, _LEAST_SIGMA_RAD),
    )
    layout = Layout(free, axes, board_scale_u_ppm > 0)
    problem = Bundle(
        layout, Corners.of(sightings), poses, sigmas, board_scale_u_ppm * 1e-6, robot.absolute_deg, earlier
    )
    state = State(
        intrinsics.vector(),
        start.flange_from_camera,
        start.base_from_board,
        0.0,
        np.zeros(axes),
        np.broadcast_to(np.eye(4), (len(sightings), 4, 4)).copy(),
    )
    adjustment = adjust(
        state,
        problem.evaluate,
        problem.move,
        problem.groups,
        layout.shared_count + 6 * len(sightings),
        calibration_name="hand-eye",
    )
    if size_px is None:
        return _result(adjustment, problem, start, stated_sigmas, tuple(sightings))
    better, doubts = _with_doubts(adjustment, problem, size_px)
    result = _result(better, problem, start, stated_sigmas, tuple(sightings))
    return replace(result, noise=replace(result.noise, pixel_px=doubts.sigma_px), doubts=doubts)


def _with_doubts(
    adjustment: Adjusted[State], problem: Bundle, size_px: tuple[int, int]
) -> tuple[Adjusted[State], Doubts]:
    """Return the result with possible errors of the model."""
    state, count = adjustment.state, len(problem.corners.parts)
    field = Field.of(state.intrinsics, problem.layout.free, size_px)
    scene = Seen(field, problem.corners, problem.camera_from_board(state))
    views = [(view, count + 2 * view, count + 2 * view + 1) for view in range(count)]
    doubts, step, covariance = doubts_of(
        adjustment, problem.evaluate(state), views, scene, range(problem.layout.hand_eye)
    )
    return replace(adjustment, state=problem.move(state, step), covariance=covariance), doubts


def _result(
    adjustment: Adjusted[State],
    problem: Bundle,
    start: Solution,
    stated_sigmas: tuple[float, float],
    sightings: tuple[Sighting, ...],
) -> HandEyeCalibration:
    layout, state = problem.layout, adjustment.state
    shared_count, units = layout.shared_count, layout.units
    turns_deg = np.degrees(rotation_vector(state.pose_errors[:, :3, :3]))
    return HandEyeCalibration(
        state.flange_from_camera,
        state.base_from_board,
        Intrinsics(*map(float, state.intrinsics)),
        layout.names,
        adjustment.covariance[:shared_count, :shared_count] * np.outer(units, units),
        adjustment.degrees[:shared_count],
        adjustment.contributions[:, :shared_count],
        adjustment.components,
        state.scale,
        state.axis_zeros_deg,
        np.hstack([state.pose_errors[:, :3, 3], turns_deg]),
        tuple(PIXEL_SIGMA_PX * r.reshape(-1, 2) for r in adjustment.residuals[: len(sightings)]),
        start,
        RobotFound(
            PIXEL_SIGMA_PX * adjustment.factor(CORNERS),
            problem.sigmas[0] * adjustment.factor(POSITION),
            float(np.degrees(problem.sigmas[1] * adjustment.factor(ORIENTATION))),
            stated_sigmas[0],
            float(np.degrees(stated_sigmas[1])),
        ),
        sightings,
        adjustment.steps,
    )

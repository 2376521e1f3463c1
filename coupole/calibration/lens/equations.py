"""Equations of the hand-eye adjustment: the dependence of each observation on the parameters, with derivatives.

The image of a corner at p on the board follows from

    p_camera = (base_from_flange_i . T(S_i a) . E_i . flange_from_camera)^-1 . base_from_board . (1 + s) p

Here base_from_flange_i is the pose that the robot reports. E_i is the arm's error at this pose alone
(repeatability, and other errors that differ from pose to pose). a are the zero errors of its axes (the part of its
absolute error that all poses share), and S_i is the arm's Jacobian. s is the relative error of the board's scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coupole.calibration import optics
from coupole.calibration.adjustment import Block, Group
from coupole.calibration.lens.corners import PIXEL_SIGMA_PX, Corners
from coupole.calibration.optics import Intrinsics
from coupole.calibration.record import step_names
from coupole.calibration.rotations import Floats, inverses, moved_transforms, rotation, rotation_vector, skew

CORNERS, POSITION, ORIENTATION, BOARD_SCALE, AXIS_ZEROS, EARLIER = (
    "corners",
    "robot position",
    "robot orientation",
    "board scale",
    "axis zeros",
    "camera record",
)
_STEP_UNITS = np.array([1.0, 1.0, 1.0, *np.degrees([1.0, 1.0, 1.0])])


@dataclass(frozen=True)
class Poses:
    """The robot's poses, one for each image."""

    base_from_flange: Floats
    """[n, 4, 4] reported poses."""
    axis_sensitivity: Floats | None = None
    """[n, 6, axes] step of the flange in its own frame (mm, rad) for each degree of each axis; None if the axes
    were not reported."""


@dataclass(frozen=True)
class EarlierLens:
    """A lens from an earlier calibration, which is held or improved."""

    intrinsics: Intrinsics
    free: tuple[str, ...] = ()
    covariance: Floats | None = None
    """[free, free] covariance of the lens; None if the lens is taken to be exact."""


@dataclass(frozen=True)
class State:
    intrinsics: Floats
    flange_from_camera: Floats
    base_from_board: Floats
    scale: float
    axis_zeros_deg: Floats
    pose_errors: Floats
    """[n, 4, 4]."""


@dataclass(frozen=True)
class Layout:
    """Columns of the shared parameters: lens, hand-eye, board, board's scale, axis zeros."""

    free: tuple[str, ...]
    axes: int
    has_scale: bool

    @property
    def hand_eye(self) -> int:
        return len(self.free)

    @property
    def board(self) -> int:
        return self.hand_eye + 6

    @property
    def scale(self) -> int:
        return self.board + 6

    @property
    def zeros(self) -> int:
        return self.scale + int(self.has_scale)

    @property
    def shared_count(self) -> int:
        return self.zeros + self.axes

    @property
    def names(self) -> tuple[str, ...]:
        lens = tuple(name + ("_px" if name[0] in "fc" else "") for name in self.free)
        scale = ("board_scale",) if self.has_scale else ()
        zeros = tuple(f"axis_zero.a{axis + 1}_deg" for axis in range(self.axes))
        return (*lens, *step_names("flange_from_camera"), *step_names("base_from_board"), *scale, *zeros)

    @property
    def units(self) -> Floats:
        """Factors [s] from the adjustment's units (mm, radians) to the units of `names`."""
        return np.concatenate(
            [np.ones(len(self.free)), _STEP_UNITS, _STEP_UNITS, np.ones(self.shared_count - self.scale)]
        )


@dataclass(frozen=True)
class Bundle:
    """The observations, and their dependence on the state."""

    layout: Layout
    corners: Corners
    poses: Poses
    sigmas: tuple[float, float]
    """Initial noise of the robot's positions and orientations: mm, radians."""
    scale_sigma: float
    zero_sigma_deg: float
    earlier: EarlierLens | None

    @property
    def groups(self) -> list[Group]:
        groups = [Group(CORNERS, True), Group(POSITION, True), Group(ORIENTATION, True)]
        groups += [Group(BOARD_SCALE, False)] if self.layout.has_scale else []
        groups += [Group(AXIS_ZEROS, False)] if self.layout.axes else []
        return groups + ([Group(EARLIER, False)] if self._lens_weight is not None else [])

    @property
    def _lens_weight(self) -> Floats | None:
        """Return W [free, free], where W'W is the inverse covariance of an earlier lens."""
        if self.earlier is None or not self.earlier.free or self.earlier.covariance is None:
            return None
        return np.asarray(np.linalg.cholesky(np.linalg.inv(self.earlier.covariance)).T)

    def evaluate(self, state: State) -> list[Block]:
        names = [group.name for group in self.groups]
        return [*self._corner_blocks(state), *self._robot_blocks(state), *self._held_blocks(state, names)]

    def camera_from_board(self, state: State) -> Floats:
        """Return [n, 4, 4], the board's pose in the camera frame at each pose of the arm."""
        base_from_camera = (
            self.poses.base_from_flange @ self._zero_steps(state) @ state.pose_errors @ state.flange_from_camera
        )
        return np.asarray(inverses(base_from_camera) @ state.base_from_board)

    def move(self, state: State, change: Floats) -> State:
        at = self.layout
        intrinsics = state.intrinsics.copy()
        intrinsics[[optics.NAMES.index(name) for name in at.free]] += change[: at.hand_eye]
        return replace(
            state,
            intrinsics=intrinsics,
            flange_from_camera=moved_transforms(state.flange_from_camera, change[at.hand_eye : at.board]),
            base_from_board=moved_transforms(state.base_from_board, change[at.board : at.scale]),
            scale=state.scale + float(change[at.scale]) if at.has_scale else state.scale,
            axis_zeros_deg=state.axis_zeros_deg + change[at.zeros : at.shared_count],
            pose_errors=moved_transforms(state.pose_errors, change[at.shared_count :].reshape(-1, 6)),
        )

    def _corner_blocks(self, state: State) -> list[Block]:
        """Return the blocks of the corners. p is transformed from the board to the base, the reported flange, the
        flange with corrected axis zeros, the true flange and the camera. Derivatives follow the same chain
        backwards."""
        at, view = self.layout, self.corners.view
        printed_mm = self.corners.board_mm
        board_mm = printed_mm * (1 + state.scale)
        board, hand_eye = state.base_from_board, state.flange_from_camera
        reported_poses = self.poses.base_from_flange[view]
        zero_steps = self._zero_steps(state)[view]
        error = state.pose_errors[view]

        in_base = board_mm @ board[:3, :3].T + board[:3, 3]
        in_reported = _into(reported_poses, in_base)
        in_zeroed = _into(zero_steps, in_reported)
        in_flange = _into(error, in_zeroed)
        in_camera = (in_flange - hand_eye[:3, 3]) @ hand_eye[:3, :3]
        projection = optics.project(in_camera, state.intrinsics)

        by_flange = projection.by_point @ hand_eye[:3, :3].T
        by_zeroed = by_flange @ np.swapaxes(error[:, :3, :3], -1, -2)
        by_reported = by_zeroed @ np.swapaxes(zero_steps[:, :3, :3], -1, -2)
        by_base = by_reported @ np.swapaxes(reported_poses[:, :3, :3], -1, -2)
        columns = [
            projection.by_intrinsics[:, :, [optics.NAMES.index(name) for name in at.free]],
            -by_flange,
            projection.by_point @ skew(in_camera),
            by_base,
            -by_base @ (board[:3, :3] @ skew(board_mm)),
        ]
        if at.has_scale:
            columns.append(by_base @ (printed_mm @ board[:3, :3].T)[:, :, None])
        if self.poses.axis_sensitivity is not None:
            by_step = np.concatenate([-by_reported, by_zeroed @ skew(in_zeroed)], axis=-1)
            columns.append(by_step @ self.poses.axis_sensitivity[view])
        columns += [-by_zeroed, by_flange @ skew(in_flange)]
        jacobian = np.concatenate(columns, axis=-1) / PIXEL_SIGMA_PX
        residuals = (self.corners.pixels - projection.pixels) / PIXEL_SIGMA_PX
        return [
            Block(
                residuals[part].ravel(),
                jacobian[part].reshape(-1, at.shared_count + 6),
                np.r_[0 : at.shared_count, self._own_columns(number)],
                0,
            )
            for number, part in enumerate(self.corners.parts)
        ]

    def _robot_blocks(self, state: State) -> list[Block]:
        """Return the blocks of the robot: the error of each pose is zero within its noise. Rotations are small, so
        the derivative of the logarithm is 1."""
        turns_rad = rotation_vector(state.pose_errors[:, :3, :3])
        position_mm, orientation_rad = self.sigmas
        blocks = []
        for number in range(len(turns_rad)):
            columns = np.arange(*self._own_columns(number).indices(2**31))
            shift = state.pose_errors[number, :3, 3]
            blocks.append(Block(-shift / position_mm, np.eye(3) / position_mm, columns[:3], 1))
            blocks.append(Block(-turns_rad[number] / orientation_rad, np.eye(3) / orientation_rad, columns[3:], 2))
        return blocks

    def _held_blocks(self, state: State, names: list[str]) -> list[Block]:
        """Return the priors: of the board's scale, the axis zeros, and an earlier lens."""
        at, blocks = self.layout, []
        if at.has_scale:
            sigma = self.scale_sigma
            scale_block = Block(np.array([-state.scale / sigma]), np.eye(1) / sigma, np.array([at.scale]), 3)
            blocks.append(replace(scale_block, group=names.index(BOARD_SCALE)))
        if at.axes:
            sigma = self.zero_sigma_deg
            columns = np.arange(at.zeros, at.shared_count)
            weight = np.eye(at.axes) / sigma
            blocks.append(Block(-state.axis_zeros_deg / sigma, weight, columns, names.index(AXIS_ZEROS)))
        weight_of_lens = self._lens_weight
        if weight_of_lens is not None and self.earlier is not None:
            free_columns = [optics.NAMES.index(name) for name in at.free]
            off = self.earlier.intrinsics.vector()[free_columns] - state.intrinsics[free_columns]
            columns = np.arange(at.hand_eye)
            blocks.append(Block(weight_of_lens @ off, weight_of_lens, columns, names.index(EARLIER)))
        return blocks

    def _own_columns(self, number: int) -> slice:
        first = self.layout.shared_count + 6 * number
        return slice(first, first + 6)

    def _zero_steps(self, state: State) -> Floats:
        """Return [n, 4, 4], the motion of the flange by the axis zeros, in its own frame."""
        steps = np.broadcast_to(np.eye(4), (len(self.poses.base_from_flange), 4, 4)).copy()
        if self.poses.axis_sensitivity is not None:
            vectors = self.poses.axis_sensitivity @ state.axis_zeros_deg
            steps[:, :3, :3], steps[:, :3, 3] = rotation(vectors[:, 3:]), vectors[:, :3]
        return steps


def _into(a_from_b: Floats, points_a: Floats) -> Floats:
    """Transform points [k, 3] from frames a into frames b, each with its own transform [k, 4, 4]."""
    away = points_a - a_from_b[:, :3, 3]
    return np.asarray(np.einsum("kij,ki->kj", a_from_b[:, :3, :3], away))

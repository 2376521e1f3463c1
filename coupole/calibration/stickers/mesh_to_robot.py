"""Pose of a scanned mesh in the base frame, from its stickers in pictures of known pose.

The scanner's table has the stickers' positions in the mesh's frame, with the scanner's accuracy. Pictures give
them in the base frame, with the accuracy of camera, hand-eye and robot. Points are found in space, and are matched
with the table by the triangles that they form. Then everything is adjusted together:

    pixel = project((base_from_flange_i . E_i . flange_from_camera)^-1 . base_from_mesh . (q_j + d_j))

Here q_j is the table's target, d_j its error, and E_i the arm's error in view i. A record observes lens, hand-eye
and, if known, the zeros of the arm's axes; all views share its error. (The source is Lucat et al. 2025, section 4,
"mesh to robot", where target and arm have no uncertainty.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.adjustment import Adjusted, Block, Group, adjust
from coupole.calibration.multi_view import CameraView, SeenPoint, seen_points
from coupole.calibration.optics import Intrinsics
from coupole.calibration.point_sets import match_points
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.rotations import Floats, between, inverses, moved_transforms, skew

STICKERS, SCANNER, POSITION, ORIENTATION, HAND_EYE = (
    "stickers",
    "scanner",
    "robot position",
    "robot orientation",
    "camera and hand-eye",
)


@dataclass(frozen=True)
class Stated:
    """Stated noise: standard deviations of each coordinate."""

    sticker_px: float = 0.1
    scanner_mm: float = 0.03
    """Accuracy of the scanner (Lucat et al. 2025: 30 um)."""
    robot_mm: float = 0.3
    robot_deg: float = 0.02
    """Noise of the arm from pose to pose."""


@dataclass(frozen=True)
class MeshPose:
    """The result. The covariance [6, 6] belongs to a step of `rotations.moved_transforms`: mm, then degrees."""

    base_from_mesh: Floats
    covariance: Floats
    recognised_names: tuple[str, ...]
    """Names of the targets that were recognised."""
    missing: tuple[str, ...]
    false_points: int
    """Number of points found in space that are not in the table."""
    views_of: dict[str, int]
    residual_px: float
    residuals_of: tuple[tuple[int, int, float], ...]
    """Residuals by view: stickers used, stickers left out as gross errors, and the rms distance of those used,
    px."""
    point_rms_mm: float
    """Root mean square distance of the points found in space from the table's, before the adjustment."""
    noise: dict[str, float]
    """Estimated noise divided by stated noise, by group."""
    redundancy: dict[str, float]
    degrees: Floats
    """[6] effective degrees of freedom."""
    dominated_by: tuple[str, ...]
    """[6] the group with the largest contribution to each variance."""

    def uncertainty_at(self, mesh_mm: Floats) -> float:
        """Return the standard uncertainty of a mesh point's position in the base frame, mm: the root of the sum of
        its variances."""
        turn = self.base_from_mesh[:3, :3]
        by_step = np.concatenate([np.eye(3), -turn @ skew(mesh_mm) * np.pi / 180], axis=1)
        return float(np.sqrt(np.trace(by_step @ self.covariance @ by_step.T)))


@dataclass(frozen=True)
class _State:
    base_from_mesh: Floats
    base_from_camera: Floats
    """[views, 4, 4]."""
    targets_mm: Floats
    """[matched, 3] targets in the mesh's frame."""
    shared_step: Floats
    """[f + 6 + k] common step of lens, hand-eye and axes from their record."""


def mesh_to_robot(
    views: Sequence[CameraView],
    intrinsics: Intrinsics,
    targets_mm: Floats,
    names: Sequence[str],
    *,
    stated_noise: Stated = Stated(),
    prior: CameraPrior | None = None,
    depth_mm: tuple[float, float] = (200.0, 900.0),
) -> MeshPose:
    """Find a mesh by its targets [n, 3] (mesh frame) and views with detected stickers.

    Without `prior` the views' poses have no common error. Raises InputError if too few stickers are seen in three
    views, or if their layout has no match or two matches.
    """
    pose_px = intrinsics.fx * (stated_noise.robot_mm / np.mean(depth_mm) + np.radians(stated_noise.robot_deg))
    tolerance_px = 4.0 * float(np.hypot(stated_noise.sticker_px, pose_px))
    tolerance_mm = 4.0 * float(
        np.sqrt(stated_noise.scanner_mm**2 + stated_noise.robot_mm**2 + (0.5 * depth_mm[0] * 1e-4) ** 2)
    )
    points = seen_points(views, intrinsics, tolerance_px=tolerance_px, depth_mm=depth_mm)
    found_mm = np.array([point.base_mm for point in points]).reshape(-1, 3)
    match = match_points(found_mm, targets_mm, tolerance_mm)
    matched_points = [points[row] for row in match.found_rows]
    adjustment = _adjust(
        views,
        intrinsics,
        matched_points,
        targets_mm[match.known_rows],
        match.found_from_known,
        stated_noise,
        prior,
    )
    matched_names = [names[row] for row in match.known_rows.tolist()]
    to_degrees = np.diag([1.0, 1.0, 1.0, *np.degrees([1.0, 1.0, 1.0])])
    sightings = sum(len(point.views) for point in matched_points)
    residuals = np.concatenate(
        [
            r[k]
            for r, k in zip(adjustment.residuals[:sightings], adjustment.accepted_masks[:sightings], strict=True)
        ]
    )
    return MeshPose(
        adjustment.state.base_from_mesh,
        to_degrees @ adjustment.covariance[:6, :6] @ to_degrees,
        tuple(matched_names),
        tuple(name for name in names if name not in set(matched_names)),
        len(points) - len(matched_points),
        {name: len(point.views) for name, point in zip(matched_names, matched_points, strict=True)},
        float(np.sqrt(np.mean(residuals**2)) * stated_noise.sticker_px),
        _by_view(adjustment, matched_points, len(views), stated_noise.sticker_px),
        match.rms_mm,
        {component.name: component.factor for component in adjustment.components},
        {component.name: component.redundancy for component in adjustment.components},
        adjustment.degrees[:6],
        tuple(adjustment.components[int(row)].name for row in adjustment.contributions[:, :6].argmax(axis=0)),
    )


def _by_view(
    adjustment: Adjusted[_State], sticker_points: Sequence[SeenPoint], views: int, sticker_px: float
) -> tuple[tuple[int, int, float], ...]:
    view_of = np.concatenate([point.views for point in sticker_points])
    view_figures = []
    for view in range(views):
        rows = np.flatnonzero(view_of == view)
        good = [row for row in rows if adjustment.accepted_masks[row].all()]
        square = sum(float(np.sum(adjustment.residuals[row] ** 2)) for row in good)
        view_figures.append(
            (len(good), len(rows) - len(good), sticker_px * float(np.sqrt(square / max(len(good), 1))))
        )
    return tuple(view_figures)


@dataclass(frozen=True)
class _Problem:
    """The observations, and their dependence on the state.

    The columns are the mesh's step [6], a step [6] for each view, an offset [3] for each target, and the figures
    that all views share [f + 6 + k].
    """

    intrinsics: Intrinsics
    stated_noise: Stated
    reported_poses: Floats
    """[v, 4, 4] base_from_camera."""
    targets_mm: Floats
    """[t, 3] positions of the recognised targets in the table."""
    observed_px: Floats
    """[n, 2] stickers in pictures, by target."""
    target_of: NDArray[np.intp]
    """[n] target of each sticker."""
    view_of: NDArray[np.intp]
    """[n] view of each sticker."""
    lens: NDArray[np.intp]
    """[f] rows of the free lens parameters in `optics.NAMES`."""
    prior_whiten: Floats
    """W [f + 6 + k, f + 6 + k], where W'W is the inverse covariance of the figures that views share."""
    by_shared: Floats
    """[v, 6, f + 6 + k] step of each reported pose for the figures that views share."""

    @property
    def first_target(self) -> int:
        return 6 + 6 * len(self.reported_poses)

    @property
    def first_shared(self) -> int:
        return self.first_target + 3 * len(self.targets_mm)

    def evaluate(self, state: _State) -> list[Block]:
        return [*self._sticker_blocks(state), *self._target_blocks(state), *self._pose_blocks(state)]

    def move(self, state: _State, step: Floats) -> _State:
        return _State(
            moved_transforms(state.base_from_mesh, step[:6]),
            moved_transforms(state.base_from_camera, step[6 : self.first_target].reshape(-1, 6)),
            state.targets_mm + step[self.first_target : self.first_shared].reshape(-1, 3),
            state.shared_step + step[self.first_shared :],
        )

    def _sticker_blocks(self, state: _State) -> list[Block]:
        turn, places = state.base_from_mesh[:3, :3], state.targets_mm[self.target_of]
        camera_from_base = inverses(state.base_from_camera)[self.view_of]
        in_base = places @ turn.T + state.base_from_mesh[:3, 3]
        in_camera = np.einsum("nij,nj->ni", camera_from_base[:, :3, :3], in_base) + camera_from_base[:, :3, 3]
        vector = self.intrinsics.vector()
        vector[self.lens] += state.shared_step[: len(self.lens)]
        projection = optics.project(in_camera, vector)
        by_base = projection.by_point @ camera_from_base[:, :3, :3]
        by_turn = by_base @ (-turn @ skew(places))
        by_view = projection.by_point @ skew(in_camera)
        by_all = [by_base, by_turn, by_base @ turn, -by_base, by_view, projection.by_intrinsics[:, :, self.lens]]
        jacobian = np.concatenate(by_all, axis=2) / self.stated_noise.sticker_px
        residuals = (self.observed_px - projection.pixels) / self.stated_noise.sticker_px
        columns = self._sticker_columns()
        return [Block(residuals[k], jacobian[k], columns[k], 0) for k in range(len(residuals))]

    def _sticker_columns(self) -> NDArray[np.intp]:
        """Return [n, 6 + 3 + 6 + f], the columns of mesh, target, view and lens."""
        pose_columns, count = np.arange(6), len(self.target_of)
        return np.concatenate(
            [
                np.tile(pose_columns, (count, 1)),
                self.first_target + 3 * self.target_of[:, None] + pose_columns[:3],
                6 + 6 * self.view_of[:, None] + pose_columns,
                np.tile(self.first_shared + np.arange(len(self.lens)), (count, 1)),
            ],
            axis=1,
        )

    def _target_blocks(self, state: _State) -> list[Block]:
        """Return the blocks of the targets. Each target lies at its place in the table, within the scanner's
        accuracy."""
        sigma_mm = self.stated_noise.scanner_mm
        blocks = []
        for row, at_mm in enumerate(state.targets_mm):
            columns = np.arange(self.first_target + 3 * row, self.first_target + 3 * row + 3)
            blocks.append(Block((self.targets_mm[row] - at_mm) / sigma_mm, np.eye(3) / sigma_mm, columns, 1))
        return blocks

    def _pose_blocks(self, state: _State) -> list[Block]:
        """Return the blocks of the poses. Each view's pose is the reported one, moved by the errors that views
        share, within the arm's noise. The shared errors are zero within the covariance of their record.
        """
        pose_sigma = np.array([self.stated_noise.robot_mm] * 3 + [np.radians(self.stated_noise.robot_deg)] * 3)
        shared_columns = self.first_shared + np.arange(len(self.prior_whiten))
        off_by = between(state.base_from_camera, self.reported_poses) + self.by_shared @ state.shared_step
        blocks = []
        for view in range(len(self.reported_poses)):
            for group, part in ((2, slice(0, 3)), (3, slice(3, 6))):
                columns = np.concatenate([6 + 6 * view + np.arange(6)[part], shared_columns])
                by_both = np.concatenate([np.eye(3), -self.by_shared[view, part]], axis=1)
                jacobian = by_both / pose_sigma[part][:, None]
                blocks.append(Block(off_by[view, part] / pose_sigma[part], jacobian, columns, group))
        return [*blocks, Block(-self.prior_whiten @ state.shared_step, self.prior_whiten, shared_columns, 4)]


def _adjust(
    views: Sequence[CameraView],
    intrinsics: Intrinsics,
    sticker_points: Sequence[SeenPoint],
    targets_mm: Floats,
    start: Floats,
    stated_noise: Stated,
    prior: CameraPrior | None,
) -> Adjusted[_State]:
    """Adjust the mesh's pose from `start`, together with the views, the targets and the figures that views
    share."""
    reported_poses = np.array([view.base_from_camera for view in views])
    groups = (
        Group(STICKERS, is_estimated=True, rejects=2),
        Group(SCANNER, is_estimated=False),
        Group(POSITION, is_estimated=True),
        Group(ORIENTATION, is_estimated=True),
        Group(HAND_EYE, is_estimated=False),
    )
    lens = np.array([], np.intp)
    if prior is None:
        whitening, by_shared = np.eye(6), np.zeros((len(views), 6, 6))
    else:
        lens = np.array([optics.NAMES.index(name) for name in prior.free], np.intp)
        whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(prior.covariance)))
        by_shared = _by_shared(reported_poses, prior)
    observed_px = np.array(
        [views[v].pixels[p] for point in sticker_points for v, p in zip(point.views, point.places, strict=True)]
    )
    target_of = np.concatenate([np.full(len(point.views), row) for row, point in enumerate(sticker_points)])
    view_of = np.concatenate([point.views for point in sticker_points])
    problem = _Problem(
        intrinsics,
        stated_noise,
        reported_poses,
        targets_mm,
        observed_px,
        target_of,
        view_of,
        lens,
        whitening,
        by_shared,
    )
    begin = _State(start, reported_poses, targets_mm, np.zeros(len(whitening)))
    unknowns = problem.first_shared + len(whitening)
    return adjust(begin, problem.evaluate, problem.move, groups, unknowns, calibration_name="mesh to robot")


def _by_shared(base_from_camera: Floats, prior: CameraPrior) -> Floats:
    """Return [v, 6, f + 6 + k], the derivative of each camera's pose. It is zero for the lens. For the hand-eye it
    is its step, rotated with the flange. For the axes it is the motion of the flange with the camera on it."""
    turn, shift = prior.flange_from_camera[:3, :3], prior.flange_from_camera[:3, 3]
    base_from_flange = base_from_camera @ inverses(prior.flange_from_camera)
    first = len(prior.free)
    by = np.zeros((len(base_from_camera), 6, first + 6))
    by[:, :, first:] = np.eye(6)
    by[:, :3, first : first + 3] = base_from_flange[:, :3, :3]
    by_axes = prior.by_axes(base_from_flange)
    of_centre = by_axes[:, :3] - base_from_flange[:, :3, :3] @ skew(shift) @ by_axes[:, 3:]
    return np.concatenate([by, np.concatenate([of_centre, turn.T @ by_axes[:, 3:]], axis=1)], axis=2)

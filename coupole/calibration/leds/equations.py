"""Equations of the LEDs' adjustment: its unknowns, its residuals divided by the stated noise, and their
derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.leds.boards import Boards
from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.spots import outline_offsets
from coupole.calibration.leds.suspects import MODES, Mode, shifts_px
from coupole.calibration.point_sets import Indices
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.rotations import Floats, between, inverses, moved_transforms, skew

SPOTS, TOLERANCE, POSITION, ORIENTATION = range(4)
GROUPS = ("spots", "LEDs on their boards", "robot position", "robot orientation")
"""Observations whose noise is estimated. The noise of table, lens and hand-eye is taken as stated."""


@dataclass(frozen=True)
class Stated:
    """Stated noise: standard deviations of each coordinate."""

    tolerance_mm: float = 0.05
    """Tolerance of the places of LEDs on their boards."""
    robot_mm: float = 0.03
    robot_deg: float = 0.003
    table_mm: float = 10.0
    """Prior deviation of boards from their table. The deviation is so large that the prior matters only for a
    board that was not seen."""
    table_deg: float = 2.0
    side_mm: float = 7.0
    """Side of an LED."""


@dataclass(frozen=True)
class LedState:
    """All that is estimated."""

    base_from_board: Floats
    offsets_mm: Floats
    """[n, 3] offsets of LEDs on their boards."""
    base_from_flange: Floats
    flange_from_camera: Floats
    lens: Floats
    axis_zeros_deg: Floats
    """[k] deviation of the arm's axis zeros from their record."""
    coefficients: Floats
    """[c] coefficients of the suspects' modes."""


@dataclass(frozen=True)
class BoardSpots:
    """The spots [k] on one board, and the data on which their equations depend."""

    rows: Indices
    """[k] rows of all spots."""
    leds: Indices
    """[k] LED of each spot: its number on the board."""
    views: Indices
    """[k] view of each spot: its number among the views of the board, in ascending order."""
    columns: Indices
    """Columns of the shared parameters: six of each view of the board, then those of the camera."""


@dataclass(frozen=True)
class Problem:
    """Quantities that do not change between iterations."""

    boards: Boards
    place: Indices
    """[k] place of each spot on its board."""
    view: Indices
    observed: Floats
    whiten: Floats
    """[k, 2, 2] factors that bring residuals to unit variance."""
    reported_poses: Floats
    prior: CameraPrior
    prior_whiten: Floats
    by_axes: Floats
    """[v, 6, k] step of each pose per degree of each axis of the arm."""
    stated_noise: Stated
    modes: tuple[Mode, ...]
    """[c] modes of the suspects."""
    spots_of: tuple[BoardSpots, ...]
    """[b]."""

    @property
    def columns_of_modes(self) -> slice:
        """Columns of the suspects among the shared parameters."""
        end = 6 * len(self.reported_poses) + self.of_camera
        return slice(end - len(self.modes), end)

    @property
    def sigmas(self) -> Floats:
        """[6] stated noise of one pose's step."""
        return np.repeat([self.stated_noise.robot_mm, np.radians(self.stated_noise.robot_deg)], 3)

    @property
    def shared_count(self) -> int:
        """Number of shared parameters: six for each view, then lens, hand-eye, suspects and axes."""
        return 6 * len(self.reported_poses) + len(self.prior_whiten)

    @property
    def of_camera(self) -> int:
        """Number of the shared parameters that belong to lens, hand-eye and suspects, on which all spots
        depend."""
        return len(self.prior.free) + 6 + len(self.modes)


def problem_of(
    sightings: LedSightings,
    place: Indices,
    boards: Boards,
    reported_poses: Floats,
    prior: CameraPrior,
    stated_noise: Stated,
    modes: Sequence[Mode] = MODES,
) -> Problem:
    """Return the problem of adjusting LEDs from their spots. `place` [k] is the place of each spot,
    `reported_poses` [v, 4, 4] are the poses of the flange, and `modes` are the modes of the suspects."""
    whiten = np.linalg.inv(np.linalg.cholesky(sightings.covariance))
    of_camera = 6 * len(reported_poses) + np.arange(6 + len(prior.free) + len(modes))
    return Problem(
        boards,
        place,
        sightings.view,
        sightings.pixels,
        whiten,
        reported_poses,
        prior,
        _prior_whiten(prior, modes),
        prior.by_axes(reported_poses),
        stated_noise,
        tuple(modes),
        tuple(_spots_of(board, sightings.view, place, boards, of_camera) for board in range(len(boards.numbers))),
    )


def _spots_of(board: int, view: Indices, place: Indices, boards: Boards, of_camera: Indices) -> BoardSpots:
    """Return the spots on a board; `view` and `place` [k] are given for all spots."""
    rows = np.flatnonzero(boards.board_of[place] == board)
    views, number = np.unique(view[rows], return_inverse=True)
    columns = np.concatenate([(6 * views[:, None] + np.arange(6)).ravel(), of_camera])
    return BoardSpots(rows, np.searchsorted(boards.rows_of(board), place[rows]), number, columns)


def _prior_whiten(prior: CameraPrior, modes: Sequence[Mode]) -> Floats:
    """Return the factor that brings `camera_step` to unit variance."""
    first = 6 + len(prior.free)
    of_modes = first + np.arange(len(modes))
    whiten = np.zeros((len(prior.covariance) + len(modes),) * 2)
    of_records = np.delete(np.arange(len(whiten)), of_modes)
    whiten[np.ix_(of_records, of_records)] = np.linalg.inv(np.linalg.cholesky(prior.covariance))
    whiten[of_modes, of_modes] = [1.0 / mode.sigma for mode in modes]
    return whiten


def with_modes(problem: Problem, modes: Sequence[Mode]) -> Problem:
    """Return the same problem with other prior standard deviations of the modes."""
    return replace(problem, modes=tuple(modes), prior_whiten=_prior_whiten(problem.prior, modes))


def at_centres(problem: Problem, state: LedState) -> Problem:
    """Return the same problem with corrected spots: moved from the centroid of the LED's outline to the image of
    its centre."""
    board_pose = state.base_from_board[problem.boards.board_of[problem.place]]
    centres = problem.boards.in_base(state.base_from_board, state.offsets_mm)[problem.place]
    camera_from_base = inverses(state.base_from_flange @ state.flange_from_camera)[problem.view]
    off = outline_offsets(board_pose, centres, camera_from_base, state.lens, problem.stated_noise.side_mm)
    return replace(problem, observed=problem.observed - off)


# -- residuals and derivatives ----------------------------------------------------------------------------


def points_seen(problem: Problem, state: LedState) -> tuple[Floats, Floats, Floats]:
    """Return the points [k, 3] in three frames: of their boards, of the flange and of the camera."""
    on_board = (problem.boards.places_mm + state.offsets_mm)[problem.place]
    pose = state.base_from_board[problem.boards.board_of[problem.place]]
    in_base = np.einsum("kij,kj->ki", pose[:, :3, :3], on_board) + pose[:, :3, 3]
    flange = state.base_from_flange[problem.view]
    in_flange = np.einsum("kji,kj->ki", flange[:, :3, :3], in_base - flange[:, :3, 3])
    in_camera = (in_flange - state.flange_from_camera[:3, 3]) @ state.flange_from_camera[:3, :3]
    return on_board, in_flange, in_camera


def whitened_residuals(problem: Problem, state: LedState) -> Floats:
    """Return the residuals [k, 2] divided by the stated noise."""
    in_camera = points_seen(problem, state)[2]
    projection = optics.project(in_camera, state.lens)
    computed_px = projection.pixels + _by_modes(problem, state, in_camera, projection) @ state.coefficients
    result: Floats = np.einsum("kij,kj->ki", problem.whiten, problem.observed - computed_px)
    return result


def _by_modes(problem: Problem, state: LedState, in_camera: Floats, projection: optics.Projected) -> Floats:
    """Return the shift [k, 2, c], px, of each spot per unit of each mode."""
    board = problem.boards.board_of[problem.place]
    flange = state.base_from_flange[problem.view, :3, :3]
    camera_from_board = (
        np.swapaxes(flange @ state.flange_from_camera[:3, :3], 1, 2) @ (state.base_from_board[board, :3, :3])
    )
    return shifts_px(problem.modes, in_camera, camera_from_board, projection, state.lens[2:4])


@dataclass(frozen=True)
class Linear:
    """Whitened residuals and derivatives of all spots."""

    residuals: Floats
    """[k, 2]."""
    by_board: Floats
    """[k, 2, 6]."""
    by_offset: Floats
    """[k, 2, 3]."""
    by_view: Floats
    """[k, 2, 6]."""
    by_camera: Floats
    """[k, 2, free + 6 + c]: lens, hand-eye, then suspects."""


def linearisation(problem: Problem, state: LedState) -> Linear:
    on_board, in_flange, in_camera = points_seen(problem, state)
    projection = optics.project(in_camera, state.lens)
    by_modes = _by_modes(problem, state, in_camera, projection)
    by_point = problem.whiten @ projection.by_point
    by_flange_point = by_point @ state.flange_from_camera[:3, :3].T
    by_base_point = by_flange_point @ np.swapaxes(state.base_from_flange[problem.view, :3, :3], 1, 2)
    turn = state.base_from_board[problem.boards.board_of[problem.place], :3, :3]
    by_offset = by_base_point @ turn
    free = [optics.NAMES.index(name) for name in problem.prior.free]
    return Linear(
        np.einsum(
            "kij,kj->ki", problem.whiten, problem.observed - projection.pixels - by_modes @ state.coefficients
        ),
        np.concatenate([by_base_point, -by_offset @ skew(on_board)], axis=2),
        by_offset,
        np.concatenate([-by_base_point, by_flange_point @ skew(in_flange)], axis=2),
        np.concatenate(
            [
                problem.whiten @ projection.by_intrinsics[:, :, free],
                -by_flange_point,
                by_point @ skew(in_camera),
                problem.whiten @ by_modes,
            ],
            axis=2,
        ),
    )


def pose_errors(problem: Problem, state: LedState) -> Floats:
    """[v, 6] error of the arm at each view, without the effect of its axis zeros."""
    off: Floats = between(problem.reported_poses, state.base_from_flange) - problem.by_axes @ state.axis_zeros_deg
    return off


def camera_step(problem: Problem, state: LedState) -> Floats:
    """Return [free + 6 + c + k]: the step from the records' values to the values of the state, with the suspects'
    coefficients."""
    free = [optics.NAMES.index(name) for name in problem.prior.free]
    hand_eye = between(problem.prior.flange_from_camera, state.flange_from_camera)
    return np.concatenate(
        [(state.lens - problem.prior.lens.vector())[free], hand_eye, state.coefficients, state.axis_zeros_deg]
    )


def cost_of(
    problem: Problem, state: LedState, factors: Floats, accepted_mask: NDArray[np.bool_], huber: float
) -> float:
    off = np.sqrt(np.sum(whitened_residuals(problem, state)[accepted_mask] ** 2, axis=1)) / factors[SPOTS]
    spots = np.where(off <= huber, off**2, huber * (2 * off - huber)) if np.isfinite(huber) else off**2
    tolerance = state.offsets_mm / problem.stated_noise.tolerance_mm / factors[TOLERANCE]
    sigmas = problem.sigmas * np.repeat(factors[[POSITION, ORIENTATION]], 3)
    poses = pose_errors(problem, state) / sigmas
    table = between(problem.boards.base_from_board, state.base_from_board) / table_sigmas(problem)
    camera = problem.prior_whiten @ camera_step(problem, state)
    return float(spots.sum() + sum(np.sum(part**2) for part in (tolerance, poses, table, camera)))


def table_sigmas(problem: Problem) -> Floats:
    return np.repeat([problem.stated_noise.table_mm, np.radians(problem.stated_noise.table_deg)], 3)


def stepped_state(
    problem: Problem, state: LedState, shared_step: Floats, own_steps: list[Floats], share: float
) -> LedState:
    views, free = len(problem.reported_poses), len(problem.prior.free)
    first_mode, axes = 6 * views + free + 6, 6 * views + problem.of_camera
    offsets, lens = state.offsets_mm.copy(), state.lens.copy()
    for board, step in enumerate(own_steps):
        offsets[problem.boards.rows_of(board)] += share * step[6:].reshape(-1, 3)
    lens[[optics.NAMES.index(name) for name in problem.prior.free]] += (
        share * shared_step[6 * views : 6 * views + free]
    )
    return LedState(
        moved_transforms(state.base_from_board, share * np.array([step[:6] for step in own_steps])),
        offsets,
        moved_transforms(state.base_from_flange, share * shared_step[: 6 * views].reshape(-1, 6)),
        moved_transforms(state.flange_from_camera, share * shared_step[6 * views + free : first_mode]),
        lens,
        state.axis_zeros_deg + share * shared_step[axes:],
        state.coefficients + share * shared_step[first_mode:axes],
    )

"""Lengths on a board as a calibrated cell measures them, with their uncertainties.

The board's corners are points in the base frame. They are found only from their images at many poses; the board's
known form gives only initial values. Lens and hand-eye are held at their record's values. The arm's error at each
pose is unknown within its stated noise. Least squares then give the points. Their covariance has two parts. The
first is noise of corners and poses, which is independent between positions of the board. The second is the errors
of lens, hand-eye and axis zeros, from the record's covariance; all positions share them. Lengths are compared as
in ISO 10360-2 and VDI/VDE 2634: five along each of four lines at each position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.lens.board import Board, Sighting
from coupole.calibration.lens.camera import board_pose
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.record import Record
from coupole.calibration.rotations import Floats, inverses, moved_transforms, rotation_vector, skew
from coupole.errors import InputError

LEAST_VIEWS = 3
_STEPS = 5
_LENGTHS = 5
"""Number of lengths along one line."""
_MOST_CORNERS = 300
"""Greatest number of corners of a board that are adjusted together."""
_LEAST_LENGTHS = 4


@dataclass(frozen=True)
class Noise:
    """Noise of single observations, from a hand-eye record: standard deviations of each coordinate."""

    corner_px: float
    position_mm: float
    orientation_rad: float

    @staticmethod
    def of(record: Record) -> Noise:
        """Return the larger of stated and estimated noise."""
        noise = {line.name: max(line.found, line.stated) for line in record.noise}
        return Noise(noise["corners"], noise["robot position"], float(np.radians(noise["robot orientation"])))


@dataclass(frozen=True)
class Position:
    """The board at one place, in pictures from several poses."""

    name: str
    sightings: tuple[Sighting, ...]
    base_from_flange: Floats
    """[views, 4, 4] poses, corrected by the axis zeros if the record has some."""
    camera: CameraPrior
    """Lens and hand-eye, and how these poses depend on the axis zeros."""


@dataclass(frozen=True)
class Lengths:
    """Measured lengths of one position."""

    position: str
    names: tuple[str, ...]
    measured_mm: Floats
    """[n]."""
    certified_mm: Floats
    """[n] at the temperature of the measurement."""
    noise_covariance: Floats
    """[n, n] covariance from corners and poses of this position, mm^2."""
    by_record: Floats
    """[n, parameters] changes of the lengths by the figures of the record, mm, in the order of
    `CameraPrior.covariance`."""
    u_certified_mm: Floats
    """[n] standard uncertainty of the certified lengths from the places of corners and from flatness. The scale,
    which all lengths share, is not included."""
    residual_ratio: float
    """Root mean square of the residuals, divided by the value that the record's noise explains."""


def lengths_of(position: Position, board: Board, noise: Noise) -> Lengths:
    """Return lengths of a board at one position. Raises InputError for too few views, or corners in too few of
    them."""
    if len(position.sightings) < LEAST_VIEWS:
        raise InputError(
            f"{position.name}: the board was found in {len(position.sightings)} pictures; expected {LEAST_VIEWS} "
            "or more, tilted to several sides"
        )
    corners = _Seen.of(position.sightings)
    points, errors, solution = _adjust(position, corners, noise)
    pairs = _pairs(board, corners.ids)
    if len(pairs) < _LEAST_LENGTHS:
        raise InputError(
            f"{position.name}: {len(pairs)} lengths between corners that {LEAST_VIEWS} pictures show; expected "
            f"{_LEAST_LENGTHS} or more. Show the whole board"
        )
    first, second = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
    way = points[first] - points[second]
    lengths_mm = np.linalg.norm(way, axis=1)
    slopes = np.zeros((len(pairs), solution.by_noise.shape[0]))
    rows = np.arange(len(pairs))[:, None]
    slopes[rows, 3 * first[:, None] + np.arange(3)] = way / lengths_mm[:, None]
    slopes[rows, 3 * second[:, None] + np.arange(3)] = -way / lengths_mm[:, None]
    flat = board.points_mm[corners.ids]
    certified_mm = np.linalg.norm(flat[first] - flat[second], axis=1)
    return Lengths(
        position.name,
        tuple(pair[2] for pair in pairs),
        lengths_mm,
        certified_mm,
        slopes @ solution.by_noise @ slopes.T,
        slopes @ solution.by_record,
        _own_u_mm(board, certified_mm),
        _residual_ratio(position, corners, points, errors, noise),
    )


def _own_u_mm(board: Board, lengths_mm: Floats) -> Floats:
    """Return the uncertainty of certified lengths without the uncertainty of the scale. If a surface lies between
    two planes at a distance f, a chord is shorter by at most 8 f^2 / (3 L). This counts as the half width of a
    rectangular distribution."""
    artefact = board.artefact
    u_corner = 0.0 if artefact is None or artefact.corner_um is None else 1e-3 * artefact.corner_um.u
    flat = 0.0 if artefact is None or artefact.flatness_um is None else 1e-3 * artefact.flatness_um.value
    u: Floats = np.hypot(np.sqrt(2.0) * u_corner, 8.0 / 3.0 * flat**2 / lengths_mm / np.sqrt(3.0))
    return u


# -- which lengths ----------------------------------------------------------------------------------------------


def _pairs(board: Board, ids: NDArray[np.intp]) -> list[tuple[int, int, str]]:
    """Return pairs of corners by their places in `ids`, with names of the lengths. There are up to five lengths
    along the middle row, the middle column and both diagonals."""
    across, down = board.corners
    place = {int(corner): n for n, corner in enumerate(ids)}
    square = min(across, down) - 1
    first_column, top = (across - 1 - square) // 2, (down - 1 - square) // 2
    lines = {
        "row": ((0, down // 2), (1, 0), across - 1),
        "column": ((across // 2, 0), (0, 1), down - 1),
        "diagonal": ((first_column, top), (1, 1), square),
        "other diagonal": ((first_column + square, top), (-1, 1), square),
    }
    pairs = []
    for name, ((x, y), (dx, dy), most) in lines.items():
        for steps in sorted({max(1, round(most * n / _LENGTHS)) for n in range(1, _LENGTHS + 1)}):
            a, b = y * across + x, (y + steps * dy) * across + x + steps * dx
            if a in place and b in place:
                pairs.append((place[a], place[b], f"{name}, {steps} squares"))
    return pairs


# -- points by their images -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Seen:
    """Corners that enough views show."""

    ids: NDArray[np.intp]
    """[m] numbers of the corners."""
    corner: NDArray[np.intp]
    """[n] index in `ids` of the corner of each observation."""
    view: NDArray[np.intp]
    """[n]."""
    pixels: Floats
    """[n, 2]."""

    @staticmethod
    def of(sightings: Sequence[Sighting]) -> _Seen:
        ids = np.concatenate([sighting.ids for sighting in sightings])
        view = np.repeat(np.arange(len(sightings)), [len(sighting.ids) for sighting in sightings])
        pixels = np.concatenate([sighting.pixels for sighting in sightings])
        numbers, counts = np.unique(ids, return_counts=True)
        kept_ids = numbers[counts >= LEAST_VIEWS]
        kept_ids = kept_ids[:: max(1, -(-len(kept_ids) // _MOST_CORNERS))]
        keep = np.isin(ids, kept_ids)
        return _Seen(kept_ids, np.searchsorted(kept_ids, ids[keep]), view[keep], pixels[keep])


@dataclass(frozen=True)
class _Solution:
    by_noise: Floats
    """[3 m, 3 m] covariance of the points from noise, mm^2."""
    by_record: Floats
    """[3 m, parameters] changes of the points by the record's figures."""


def _adjust(position: Position, corners: _Seen, noise: Noise) -> tuple[Floats, Floats, _Solution]:
    """Return points [m, 3] in the base frame, the arm's errors [views, 4, 4], and the dependence of the points on
    everything else."""
    points = _start(position, corners)
    views, size = len(position.sightings), 3 * len(corners.ids)
    errors = np.broadcast_to(np.eye(4), (views, 4, 4)).copy()
    prior = np.r_[[noise.position_mm] * 3, [noise.orientation_rad] * 3] ** -2.0
    for _ in range(_STEPS):
        residuals, jacobian, by_record = _equations(position, corners, points, errors)
        weighted_jacobian = jacobian / noise.corner_px**2
        normal = jacobian.T @ weighted_jacobian
        normal[range(size, len(normal)), range(size, len(normal))] += np.tile(prior, views)
        off = np.concatenate([errors[:, :3, 3], rotation_vector(errors[:, :3, :3])], axis=1)
        right_side = weighted_jacobian.T @ residuals
        right_side[size:] -= (prior * off).ravel()
        step = np.asarray(np.linalg.solve(normal, right_side), np.float64)
        points = points + step[:size].reshape(-1, 3)
        errors = moved_transforms(errors, step[size:].reshape(-1, 6))
    covariance = np.asarray(np.linalg.inv(normal), np.float64)
    return (
        points,
        errors,
        _Solution(covariance[:size, :size], -(covariance @ (weighted_jacobian.T @ by_record))[:size]),
    )


def _start(position: Position, corners: _Seen) -> Floats:
    """Return points [m, 3] from the board's pose in the view that shows most of it."""
    best = int(np.argmax([len(sighting.ids) for sighting in position.sightings]))
    base_from_camera = position.base_from_flange[best] @ position.camera.flange_from_camera
    base_from_board = base_from_camera @ board_pose(position.sightings[best], position.camera.lens)
    board_mm = np.full((int(corners.ids.max()) + 1, 3), np.nan)
    for sighting in position.sightings:
        inside = sighting.ids < len(board_mm)
        board_mm[sighting.ids[inside]] = sighting.board_mm[inside]
    points: Floats = board_mm[corners.ids] @ base_from_board[:3, :3].T + base_from_board[:3, 3]
    return points


def _equations(
    position: Position, corners: _Seen, points: Floats, errors: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return residuals [2 n], their derivatives by points and errors [2 n, 3 m + 6 views], and by the record's
    figures.

    A point is transformed from the base to the flange, to the flange without the arm's error, and to the camera.
    Derivatives follow the same chain backwards, as in `lens.equations`.
    """
    camera, view = position.camera, corners.view
    hand_eye, flange = camera.flange_from_camera, position.base_from_flange[view]
    in_reported = _into(flange, points[corners.corner])
    in_flange = _into(errors[view], in_reported)
    in_camera = (in_flange - hand_eye[:3, 3]) @ hand_eye[:3, :3]
    projection = optics.project(in_camera, camera.lens.vector())
    by_flange = projection.by_point @ hand_eye[:3, :3].T
    by_reported = by_flange @ np.swapaxes(errors[view][:, :3, :3], -1, -2)
    by_base = by_reported @ np.swapaxes(flange[:, :3, :3], -1, -2)
    count, size = len(view), 3 * len(points)
    jacobian = np.zeros((count, 2, size + 6 * len(errors)))
    rows = np.arange(count)[:, None]
    by_error = np.concatenate([-by_reported, by_flange @ skew(in_flange)], axis=-1)
    jacobian[rows, :, 3 * corners.corner[:, None] + np.arange(3)] = np.swapaxes(by_base, 1, 2)
    jacobian[rows, :, size + 6 * view[:, None] + np.arange(6)] = np.swapaxes(by_error, 1, 2)
    lens = projection.by_intrinsics[:, :, [optics.NAMES.index(name) for name in camera.free]]
    by_record = [lens, -by_flange, projection.by_point @ skew(in_camera)]
    if camera.axis_sensitivity is not None:
        by_step = np.concatenate([-by_reported, by_reported @ skew(in_reported)], axis=-1)
        by_record.append(by_step @ camera.axis_sensitivity[view])
    residuals = (corners.pixels - projection.pixels).ravel()
    return residuals, jacobian.reshape(2 * count, -1), np.concatenate(by_record, axis=-1).reshape(2 * count, -1)


def _into(a_from_b: Floats, points_a: Floats) -> Floats:
    """Transform points [k, 3] from frames a into frames b, each with its own transform [k, 4, 4]."""
    b_from_a = inverses(a_from_b)
    return np.asarray(np.einsum("kij,kj->ki", b_from_a[:, :3, :3], points_a) + b_from_a[:, :3, 3])


def _residual_ratio(position: Position, corners: _Seen, points: Floats, errors: Floats, noise: Noise) -> float:
    residuals, _, _ = _equations(position, corners, points, errors)
    freedom = max(1, len(residuals) - points.size)
    return float(np.sqrt(np.sum(residuals**2) / freedom) / noise.corner_px)

"""Pose of the camera on the flange: solves A X = X B in closed form, by three methods.

X is `flange_from_camera`. The board and the base stand still, so base_from_flange_i X camera_from_board_i is the
same for all poses i. So each pair of poses gives one equation A X = X B, where A is the motion of the flange and B
the motion of the camera. The methods weight errors differently. If they disagree by more than noise explains, the
data have another error (`coupole.calibration.lens.diagnosis`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coupole.calibration.rotations import (
    Floats,
    between,
    inverses,
    nearest_rotation,
    quaternion,
    rotation_vector,
    skew,
)
from coupole.errors import InputError

LEAST_POSES = 3
_LEAST_TURN_RAD = 0.02
_NEAR_HALF_TURN = 0.05
"""Limit of cos(half the angle). Below it, noise determines the sign of the rotation axis."""


@dataclass(frozen=True)
class Motions:
    """Motions between pairs of poses: `flange` A and `camera` B, [pairs, 4, 4] each."""

    flange: Floats
    camera: Floats


@dataclass(frozen=True)
class Solution:
    """Both unknown transforms, and the deviation of each pose from this solution."""

    flange_from_camera: Floats
    base_from_board: Floats
    scatter: Floats
    """[n, 6] deviations of the board's pose in each pose from the mean: mm, radians."""

    @property
    def scatter_mm(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean(np.sum(self.scatter[:, :3] ** 2, axis=1))))

    @property
    def scatter_deg(self) -> float:
        """Root mean square angle."""
        return float(np.degrees(np.sqrt(np.mean(np.sum(self.scatter[:, 3:] ** 2, axis=1)))))


def motions(base_from_flange: Floats, camera_from_board: Floats) -> Motions:
    """Return the motions of all pairs of poses [n, 4, 4], without those with a rotation of nearly 180 degrees,
    whose axes have no sign.

    Raises InputError if all motions have the same rotation axis, because X is then not determined.
    """
    count = len(base_from_flange)
    if count < LEAST_POSES:
        raise InputError(f"hand-eye: expected at least {LEAST_POSES} poses, found {count}. Take 10 to 60.")
    first, second = np.triu_indices(count, 1)
    flange = inverses(base_from_flange)[second] @ base_from_flange[first]
    camera = camera_from_board[second] @ inverses(camera_from_board)[first]
    clear = np.minimum(*(quaternion(m[:, :3, :3])[:, 0] for m in (flange, camera))) > _NEAR_HALF_TURN
    turns = rotation_vector(camera[clear, :3, :3])
    if len(turns) < 2 or np.linalg.svd(turns, compute_uv=False)[1] < _LEAST_TURN_RAD * np.sqrt(len(turns)):
        raise InputError(
            "hand-eye: the poses turn about one axis only, so the camera's place along it cannot be known. "
            "Take poses tilted to several sides and rolled about the view."
        )
    return Motions(flange[clear], camera[clear])


def park(pairs: Motions) -> Floats:
    """`flange_from_camera`. Park and Martin, Robot sensor calibration, IEEE Trans. Robotics and Automation 10(5),
    1994.

    With alpha = log R_A and beta = log R_B, alpha = R_X beta; the least-squares R_X is the rotation nearest to the
    sum of alpha beta^T (their (M^T M)^-1/2 M^T). Translation: (R_A - I) t_X = R_X t_B - t_A.
    """
    alpha, beta = rotation_vector(pairs.flange[:, :3, :3]), rotation_vector(pairs.camera[:, :3, :3])
    return _with_translation(nearest_rotation(alpha.T @ beta), pairs)


def tsai(pairs: Motions) -> Floats:
    """`flange_from_camera`. Tsai and Lenz, IEEE Trans. Robotics and Automation 5(3), 1989.

    With P = 2 sin(angle/2) times the axis: skew(P_A + P_B) P' = P_B - P_A, P_X = 2 P' / sqrt(1 + |P'|^2), and
    R_X = (1 - |P|^2/2) I + (P P^T + sqrt(4 - |P|^2) skew(P)) / 2 with P = P_X.
    """
    of_a, of_b = (2 * quaternion(motion[:, :3, :3])[:, 1:] for motion in (pairs.flange, pairs.camera))
    half = np.linalg.lstsq(skew(of_a + of_b).reshape(-1, 3), (of_b - of_a).ravel(), rcond=None)[0]
    p = 2 * half / np.sqrt(1 + half @ half)
    square = p @ p
    turn = (1 - square / 2) * np.eye(3) + 0.5 * (np.outer(p, p) + np.sqrt(4 - square) * skew(p))
    return _with_translation(turn, pairs)


def daniilidis(pairs: Motions) -> Floats:
    """`flange_from_camera`. Daniilidis, Hand-eye calibration using dual quaternions, Int. J. Robotics Research
    18(3), 1999: rotation and translation at once.

    Each motion gives six rows of T, T (q, q') = 0; the solution lies in the plane of T's last two right singular
    vectors, where |q| = 1 and q . q' = 0 leave a quadratic equation.
    """
    a, b = quaternion(pairs.flange[:, :3, :3]), quaternion(pairs.camera[:, :3, :3])
    a_dual, b_dual = _dual(a, pairs.flange[:, :3, 3]), _dual(b, pairs.camera[:, :3, 3])
    rows = np.zeros((len(a), 6, 8))
    rows[:, :3, 0] = rows[:, 3:, 4] = (a - b)[:, 1:]
    rows[:, :3, 1:4] = rows[:, 3:, 5:] = skew((a + b)[:, 1:])
    rows[:, 3:, 0] = (a_dual - b_dual)[:, 1:]
    rows[:, 3:, 1:4] = skew((a_dual + b_dual)[:, 1:])
    seventh, eighth = np.linalg.svd(rows.reshape(-1, 8), full_matrices=False)[2][-2:]
    u, u_dual, v, v_dual = seventh[:4], seventh[4:], eighth[:4], eighth[4:]
    coefficients = np.array([u @ u_dual, u @ v_dual + v @ u_dual, v @ v_dual])
    is_flipped = abs(coefficients[2]) > abs(coefficients[0])  # avoids division by a small leading coefficient
    ratios = np.real(np.roots(coefficients[::-1] if is_flipped else coefficients))
    pairs_of_weights = [(1.0, r) if is_flipped else (r, 1.0) for r in ratios]
    weights = max(pairs_of_weights, key=lambda w: _norm2(w, u, v) / (w[0] ** 2 + w[1] ** 2))
    scale = 1 / np.sqrt(_norm2(weights, u, v))
    q, q_dual = (scale * (weights[0] * x + weights[1] * y) for x, y in ((u, v), (u_dual, v_dual)))
    x = np.eye(4)
    w, axis = q[0], q[1:]
    x[:3, :3] = nearest_rotation((w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * skew(axis))
    x[:3, 3] = 2 * (w * q_dual[1:] - q_dual[0] * axis + np.cross(axis, q_dual[1:]))
    return x


METHODS: dict[str, Callable[[Motions], Floats]] = {"Park": park, "Daniilidis": daniilidis, "Tsai": tsai}


def solve(
    base_from_flange: Floats, camera_from_board: Floats, method: Callable[[Motions], Floats] = park
) -> Solution:
    """Return hand-eye and board from poses [n, 4, 4]. The board's place is the mean over the poses."""
    flange_from_camera = method(motions(base_from_flange, camera_from_board))
    return solution(base_from_flange, camera_from_board, flange_from_camera)


def solution(base_from_flange: Floats, camera_from_board: Floats, flange_from_camera: Floats) -> Solution:
    """Return the board's pose and scatter for a given hand-eye transform."""
    boards = base_from_flange @ flange_from_camera @ camera_from_board
    mean = np.eye(4)
    mean[:3, :3], mean[:3, 3] = nearest_rotation(boards[:, :3, :3].mean(axis=0)), boards[:, :3, 3].mean(axis=0)
    return Solution(flange_from_camera, mean, between(np.broadcast_to(mean, boards.shape), boards))


def _with_translation(turn: Floats, pairs: Motions) -> Floats:
    """Solve (R_A - I) t_X = R_X t_B - t_A by least squares over all pairs."""
    x = np.eye(4)
    x[:3, :3] = turn
    left_side = (pairs.flange[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right_side = (pairs.camera[:, :3, 3] @ turn.T - pairs.flange[:, :3, 3]).ravel()
    x[:3, 3] = np.linalg.lstsq(left_side, right_side, rcond=None)[0]
    return x


def _dual(q: Floats, translation_mm: Floats) -> Floats:
    """Return the dual part (0, t) q / 2 of rigid motions [n, 4]."""
    scalar, vector = q[:, :1], q[:, 1:]
    top = -np.sum(translation_mm * vector, axis=1, keepdims=True)
    return np.asarray(0.5 * np.hstack([top, scalar * translation_mm + np.cross(translation_mm, vector)]))


def _norm2(weights: tuple[float, float], u: Floats, v: Floats) -> float:
    q = weights[0] * u + weights[1] * v
    return float(q @ q)

"""Possible errors in the poses of a robot or the images of a board, and the scatter that remains if they are real.

Each hypothesis is another interpretation of the data (other units or angles, the inverse pose, another pairing, a
board in two places), with the scatter of the board's position that it leaves. `coupole.calibration.lens.diagnosis`
ranks them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.special import fdtrc

from coupole.calibration.lens.hand_eye import Motions, Solution, motions, park, solution, solve
from coupole.calibration.poses import Convention, ReportedPoses
from coupole.calibration.rotations import Floats, between
from coupole.errors import InputError

_LEAST_SEGMENT = 3
_SUSPECTS = 6
_PLAUSIBLE_MM = (5.0, 5000.0)
"""Possible distances in a cell: between camera and board, and of the robot's travel."""
_SURE = 1e-4
"""Probability that a step of the board is noise. Below it the board was moved, even if the step is small."""

UNITS, ANGLES, INVERSE, MOVED_BOARD, WRONG_PAIR, SHIFTED = (
    "wrong unit",
    "angle convention",
    "inverse pose",
    "moved board",
    "wrong pair",
    "shifted pairs",
)


@dataclass(frozen=True)
class Expected:
    """Root mean square scatter of the board that noise explains."""

    position_mm: float
    orientation_deg: float

    def score(self, scatter_mm: float, scatter_deg: float) -> float:
        """Return the larger of two ratios, for position and for orientation: scatter divided by the expected
        scatter."""
        return max(scatter_mm / self.position_mm, scatter_deg / self.orientation_deg)


@dataclass(frozen=True)
class Hypothesis:
    """A possible error, and the scatter that remains if it is real."""

    causes: tuple[str, ...]
    """Names, as in this module's constants."""
    sentence: str
    scatter_mm: float
    scatter_deg: float
    sure: bool = False
    """True for deviations that noise cannot explain, even if the scatter decreases only a little."""


def scatter_of(base_from_flange: Floats, camera_from_board: Floats) -> tuple[float, float]:
    """Return the scatter, mm and degrees; infinite if the motions have no solution."""
    try:
        hand_eye = solve(base_from_flange, camera_from_board)
    except InputError:
        return np.inf, np.inf
    return hand_eye.scatter_mm, hand_eye.scatter_deg


def rereadings(poses: ReportedPoses, camera_from_board: Floats) -> Iterator[Hypothesis]:
    """Yield hypotheses on the convention of all poses."""
    yield from _other_conventions(poses, camera_from_board)
    yield from _other_board_unit(poses.base_from_flange, camera_from_board)


def faults(
    base_from_flange: Floats, camera_from_board: Floats, names: Sequence[str], noise_scatter: Expected
) -> Iterator[Hypothesis]:
    """Yield hypotheses on single poses and images."""
    yield from _wrong_pairs(base_from_flange, camera_from_board, names)
    yield from _moved_board(base_from_flange, camera_from_board, names, noise_scatter)


def _other_conventions(poses: ReportedPoses, camera_from_board: Floats) -> Iterator[Hypothesis]:
    convention = poses.convention
    turns: list[tuple[str, dict[str, object]]] = [("", {})]
    if convention.rotation != "quaternion_wxyz":
        turns = [
            (words, {"rotation": kind, "order": order})
            for kind, word in (("abc", "Rz Ry Rx"), ("xyz", "Rx Ry Rz"), ("rotation_vector", "a rotation vector"))
            for order in ([(0, 1, 2)] if kind == "rotation_vector" else permutations(range(3)))
            for words in [f"{word}{'' if order == (0, 1, 2) else f' with the numbers in the order {order}'}"]
        ]
    other_length = "m" if convention.length_unit == "mm" else "mm"
    other_angle = "rad" if convention.angle_unit == "deg" else "deg"
    other_sense = "flange_from_base" if convention.gives == "base_from_flange" else "base_from_flange"
    for length, angle, sense, (words, turn) in product(
        (convention.length_unit, other_length),
        (convention.angle_unit, other_angle),
        (convention.gives, other_sense),
        turns,
    ):
        reading = convention.model_copy(
            update={"length_unit": length, "angle_unit": angle, "gives": sense, **turn}
        )
        if reading != convention and not (
            convention.rotation == "quaternion_wxyz" and angle != convention.angle_unit
        ):
            yield from _if_read_as(poses.numbers, convention, reading, words, camera_from_board)


def _if_read_as(
    numbers: Floats,
    stated_convention: Convention,
    assumed_convention: Convention,
    words: str,
    camera_from_board: Floats,
) -> Iterator[Hypothesis]:
    as_read = replace(ReportedPoses(numbers, stated_convention), convention=assumed_convention).base_from_flange
    way_mm = float(np.median(np.linalg.norm(as_read[:, :3, 3] - as_read[:, :3, 3].mean(axis=0), axis=1)))
    if not _PLAUSIBLE_MM[0] < way_mm < _PLAUSIBLE_MM[1]:
        return
    causes, says = [], []
    if assumed_convention.length_unit != stated_convention.length_unit:
        causes.append(UNITS)
        says.append(f"positions are in {assumed_convention.length_unit}, not {stated_convention.length_unit}")
    if assumed_convention.angle_unit != stated_convention.angle_unit:
        causes.append(UNITS)
        says.append(
            f"angles are in {_WORDS[assumed_convention.angle_unit]}, not {_WORDS[stated_convention.angle_unit]}"
        )
    if (assumed_convention.rotation, assumed_convention.order) != (
        stated_convention.rotation,
        stated_convention.order,
    ):
        causes.append(ANGLES)
        says.append(f"rotations are {words}")
    if assumed_convention.gives != stated_convention.gives:
        causes.append(INVERSE)
        says.append(f"poses are {assumed_convention.gives}, not {stated_convention.gives}")
    yield Hypothesis(tuple(causes), " and ".join(says), *scatter_of(as_read, camera_from_board))


_WORDS = {"deg": "degrees", "rad": "radians"}


def _other_board_unit(base_from_flange: Floats, camera_from_board: Floats) -> Iterator[Hypothesis]:
    """Yield the hypotheses that the board's squares are given in m, or in um."""
    for factor, unit in ((1000.0, "m"), (1e-3, "um")):
        scaled_poses = camera_from_board.copy()
        scaled_poses[:, :3, 3] *= factor
        distance_mm = float(np.median(np.linalg.norm(scaled_poses[:, :3, 3], axis=1)))
        if _PLAUSIBLE_MM[0] < distance_mm < _PLAUSIBLE_MM[1]:
            sentence = f"the board's squares are given in {unit}, not mm"
            yield Hypothesis((UNITS,), sentence, *scatter_of(base_from_flange, scaled_poses))


def _wrong_pairs(
    base_from_flange: Floats, camera_from_board: Floats, names: Sequence[str]
) -> Iterator[Hypothesis]:
    """Yield the hypotheses that one image does not belong to its pose, that two images are exchanged, or that all
    are shifted by one."""
    count = len(base_from_flange)
    for left_out in range(count if count > _LEAST_SEGMENT + 1 else 0):
        keep = [i for i in range(count) if i != left_out]
        sentence = f"image and pose of {names[left_out]} do not belong together"
        yield Hypothesis((WRONG_PAIR,), sentence, *scatter_of(base_from_flange[keep], camera_from_board[keep]))
    if count > _LEAST_SEGMENT + 1:
        for first, second in combinations(_worst(base_from_flange, camera_from_board), 2):
            order = np.arange(count)
            order[[first, second]] = second, first
            sentence = f"the poses of {names[min(first, second)]} and {names[max(first, second)]} are exchanged"
            yield Hypothesis((WRONG_PAIR,), sentence, *scatter_of(base_from_flange[order], camera_from_board))
        for words, flange, camera in (
            ("after", base_from_flange[1:], camera_from_board[:-1]),
            ("before", base_from_flange[:-1], camera_from_board[1:]),
        ):
            yield Hypothesis(
                (SHIFTED,), f"each image belongs to the pose {words} its own", *scatter_of(flange, camera)
            )


def _worst(base_from_flange: Floats, camera_from_board: Floats) -> list[int]:
    """Return the poses with the largest deviation of the board from its median position. They are few, because all
    pairs of them are tried."""
    try:
        boards = (
            base_from_flange @ solve(base_from_flange, camera_from_board).flange_from_camera @ camera_from_board
        )
    except InputError:
        return []
    places = boards[:, :3, 3]
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return [int(number) for number in np.argsort(-away)[:_SUSPECTS]]


def _moved_board(
    base_from_flange: Floats, camera_from_board: Floats, names: Sequence[str], noise_scatter: Expected
) -> Iterator[Hypothesis]:
    """Yield the hypotheses that the board was in two places. Motions within each part are then valid; motions
    between the parts are not."""
    count = len(base_from_flange)
    for change in range(_LEAST_SEGMENT, count - _LEAST_SEGMENT + 1):
        parts = slice(None, change), slice(change, None)
        try:
            pairs = [motions(base_from_flange[part], camera_from_board[part]) for part in parts]
        except InputError:
            continue
        all_motions = Motions(
            *(np.concatenate([getattr(p, field) for p in pairs]) for field in ("flange", "camera"))
        )
        flange_from_camera = park(all_motions)
        before, after = (solution(base_from_flange[p], camera_from_board[p], flange_from_camera) for p in parts)
        step = between(before.base_from_board, after.base_from_board)
        scatter = np.concatenate([before.scatter, after.scatter])
        pooled_solution = replace(before, scatter=scatter)
        step_mm, step_deg = float(np.linalg.norm(step[:3])), float(np.degrees(np.linalg.norm(step[3:])))
        sentence = (
            f"the board was moved between {names[change - 1]} and {names[change]}, by {step_mm:.3g} mm and "
            f"{step_deg:.3g} deg"
        )
        sure = noise_scatter.score(step_mm, step_deg) > 1.0 and _by_chance(before, after) * count < _SURE
        yield Hypothesis((MOVED_BOARD,), sentence, pooled_solution.scatter_mm, pooled_solution.scatter_deg, sure)


def _by_chance(before: Solution, after: Solution) -> float:
    """Return the probability that noise alone causes a step as large as the step between the boards of the two
    parts.

    It is Hotelling's T^2 of two samples with a common covariance (Anderson, An Introduction to Multivariate
    Statistical Analysis, 3rd ed., 2003, section 5.3.4), with six degrees of freedom less, because both parts share
    the hand-eye.
    """
    first, second = len(before.scatter), len(after.scatter)
    degrees = first + second - 2 - 6
    size = before.scatter.shape[1]
    if degrees <= size:
        return 1.0
    covariance = (before.scatter.T @ before.scatter + after.scatter.T @ after.scatter) / degrees
    step = between(before.base_from_board, after.base_from_board)
    t_squared = first * second / (first + second) * float(step @ np.linalg.solve(covariance, step))
    return float(fdtrc(size, degrees - size + 1, t_squared * (degrees - size + 1) / (degrees * size)))

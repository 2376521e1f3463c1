"""Diagnosis of robot and camera that contradict each other: the most likely cause.

If the board's position scatters from pose to pose by more than noise explains, the data are wrong. Each hypothesis
is another interpretation of the data: another unit, other angles, the inverse pose, a board that was moved, or a
wrong pair. A hypothesis that removes the contradiction is a likely cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import stdtrit

from coupole.calibration.lens.hand_eye import METHODS, motions, solution
from coupole.calibration.lens.hypotheses import Expected, Hypothesis, faults, rereadings, scatter_of
from coupole.calibration.poses import ReportedPoses
from coupole.calibration.rotations import Floats, between, inverses, moved_transforms
from coupole.errors import InputError

CONTRADICTION = 3.0
"""Scatter divided by the scatter expected from noise. Above this ratio, the scatter has another cause."""
CURE = 3.0
"""A hypothesis that divides the scatter by this factor is a likely cause."""
_NO_WORSE = 0.7
_WORTH_A_LOOK = 0.3
"""Scatter divided by the expected scatter. Above this ratio single faults are searched for, because the stated
noise of a poor robot may hide a moved board."""
_AS_GOOD = 1.5
"""Hypotheses whose scatter is within this factor of the best are ranked: the smallest change comes first."""
_DEPTH_WORSE = 5.0
"""Uncertainty of a board's distance, divided by the uncertainty of its position across the image."""
_FALSE_ALARMS = 0.01
_RESAMPLED = 24


@dataclass(frozen=True)
class Disagreement:
    """Difference of the results of two methods."""

    methods: tuple[str, str]
    distance_mm: float
    angle_deg: float
    sigmas: float
    """Largest difference of the six components, divided by its uncertainty."""
    beyond_noise: bool
    """True if they differ by more than the noise of the poses explains."""


@dataclass(frozen=True)
class Diagnosis:
    """Findings: the scatter, its likely causes, and methods that disagree."""

    scatter_mm: float
    scatter_deg: float
    noise_scatter: Expected
    likely: tuple[Hypothesis, ...]
    """Likely causes, best first; empty if nothing is wrong, or if no hypothesis helps."""
    disagreements: tuple[Disagreement, ...]

    @property
    def contradicts(self) -> bool:
        return bool(self.likely) or self.noise_scatter.score(self.scatter_mm, self.scatter_deg) > CONTRADICTION

    @property
    def cause(self) -> str | None:
        """The likely cause's name; several names are joined by `and`."""
        return " and ".join(self.likely[0].causes) if self.likely else None

    def sentences(self) -> tuple[str, ...]:
        """The findings as text; empty if robot and camera agree."""
        lines = []
        if self.contradicts:
            lines.append(
                "robot and camera contradict each other: the board's place as computed from the poses scatters "
                f"by {self.scatter_mm:.3g} mm and {self.scatter_deg:.3g} deg, where noise explains "
                f"{self.noise_scatter.position_mm:.2g} mm and {self.noise_scatter.orientation_deg:.2g} deg"
            )
            lines += [
                f"likely cause: {h.sentence}. With this correction {h.scatter_mm:.3g} mm and "
                f"{h.scatter_deg:.3g} deg remain"
                for h in self.likely[:1]
            ]
            if not self.likely:
                lines.append(
                    "no simple cause explains it: the robot may be worse than stated, or the board not flat"
                )
        lines += [
            f"{d.methods[0]}'s and {d.methods[1]}'s methods disagree by {d.distance_mm:.3g} mm and "
            f"{d.angle_deg:.3g} deg, {d.sigmas:.1f} times what noise explains"
            for d in self.disagreements
            if d.beyond_noise
        ]
        return tuple(lines)

    def of_methods(self) -> str:
        """Differences of the closed forms, significant or not; empty if there are too few poses."""
        if not self.disagreements:
            return ""
        apart = ", ".join(
            f"{d.methods[0]} and {d.methods[1]} by {d.distance_mm:.2g} mm and {d.angle_deg:.2g} deg "
            f"({d.sigmas:.1f} sigma)"
            for d in self.disagreements
        )
        return f"methods differ: {apart}"


def expected_scatter(
    camera_from_board: Floats, *, pixel_px: float, focal_px: float, robot_mm: float, robot_deg: float
) -> Expected:
    """Return the scatter that follows from the corners' noise and the robot's stated noise, at the board's
    distance."""
    distance_mm = float(np.median(np.linalg.norm(camera_from_board[:, :3, 3], axis=1)))
    seen_rad = _DEPTH_WORSE * pixel_px / focal_px
    turned_rad = np.radians(robot_deg)
    position = np.sqrt(3 * robot_mm**2 + 2 * (turned_rad * distance_mm) ** 2 + (seen_rad * distance_mm) ** 2)
    return Expected(float(position), float(np.degrees(np.sqrt(3 * (turned_rad**2 + seen_rad**2)))))


def diagnose(
    poses: ReportedPoses, camera_from_board: Floats, noise_scatter: Expected, names: Sequence[str]
) -> Diagnosis:
    """Compare poses [n] with the board's poses from the images [n, 4, 4]; `names` are the names of the images."""
    scatter = scatter_of(poses.base_from_flange, camera_from_board)
    diagnosis, score = Diagnosis(*scatter, noise_scatter, (), ()), noise_scatter.score(*scatter)
    if score > _WORTH_A_LOOK:
        candidates = list(rereadings(poses, camera_from_board)) if score > CONTRADICTION else []
        candidates += faults(poses.base_from_flange, camera_from_board, names, noise_scatter)
        diagnosis = replace(diagnosis, likely=_likely(candidates, noise_scatter, scatter))
    if np.isfinite(scatter[0]):
        apart = disagreements(poses.base_from_flange, camera_from_board, noise_scatter)
        diagnosis = replace(diagnosis, disagreements=apart)
    return diagnosis


def disagreements(
    base_from_flange: Floats, camera_from_board: Floats, noise_scatter: Expected
) -> tuple[Disagreement, ...]:
    """Return the difference of each two methods, and whether expected noise explains it.

    The effect of noise is simulated: poses are made consistent by Park's result, and new noise is drawn
    (parametric bootstrap; Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 6). The result is
    empty if the poses have no solution.
    """
    try:
        hand_eye_of = _by_method(base_from_flange, camera_from_board)
        board = solution(base_from_flange, camera_from_board, hand_eye_of["Park"]).base_from_board
        consistent = inverses(base_from_flange @ hand_eye_of["Park"]) @ board
        random = np.random.default_rng(0)
        per_axis = np.repeat([noise_scatter.position_mm, np.radians(noise_scatter.orientation_deg)], 3) / np.sqrt(
            3
        )
        draws = [
            _by_method(
                base_from_flange, moved_transforms(consistent, per_axis * random.normal(size=(len(consistent), 6)))
            )
            for _ in range(_RESAMPLED)
        ]
    except InputError:
        return ()
    limit = float(stdtrit(_RESAMPLED, 1 - _FALSE_ALARMS / (2 * 6 * len(METHODS))))
    comparisons = []
    for first, second in combinations(METHODS, 2):
        difference = between(hand_eye_of[first], hand_eye_of[second])
        by_noise = between(np.stack([d[first] for d in draws]), np.stack([d[second] for d in draws]))
        sigma = np.sqrt(np.mean(by_noise**2, axis=0))
        sigmas = float(np.max(np.abs(difference) / np.maximum(sigma, 1e-12)))
        distance_mm, angle_deg = np.linalg.norm(difference[:3]), np.degrees(np.linalg.norm(difference[3:]))
        comparisons.append(
            Disagreement(
                (first, second), float(distance_mm), float(angle_deg), sigmas, beyond_noise=sigmas > limit
            )
        )
    return tuple(comparisons)


def _by_method(base_from_flange: Floats, camera_from_board: Floats) -> dict[str, Floats]:
    """Return `flange_from_camera` by each method."""
    pairs = motions(base_from_flange, camera_from_board)
    return {name: method(pairs) for name, method in METHODS.items()}


def _likely(
    hypotheses: list[Hypothesis], noise_scatter: Expected, measured_scatter: tuple[float, float]
) -> tuple[Hypothesis, ...]:
    """Return hypotheses that remove the contradiction. Among equally good hypotheses, the smallest change comes
    first.

    Such a hypothesis divides the scatter of positions or of orientations by the factor `CURE` and does not
    increase the other. Or it explains a deviation that noise cannot explain.
    """
    cures = []
    for h in hypotheses:
        gains = measured_scatter[0] / max(h.scatter_mm, 1e-12), measured_scatter[1] / max(h.scatter_deg, 1e-12)
        if (max(gains) > CURE or h.sure) and min(gains) > _NO_WORSE:
            cures.append(h)
    if not cures:
        return ()
    best = min(noise_scatter.score(h.scatter_mm, h.scatter_deg) for h in cures)

    def rank(h: Hypothesis) -> tuple[bool, int, float]:
        score = noise_scatter.score(h.scatter_mm, h.scatter_deg)
        return score > _AS_GOOD * best, len(h.causes), score

    return tuple(sorted(cures, key=rank))

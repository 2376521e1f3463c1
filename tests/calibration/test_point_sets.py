"""Stickers matched by the triangles that they form: the right pairs, or none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coupole.calibration.point_sets import match_points, rigid_motion
from coupole.errors import InputError

TOLERANCE_MM = 0.3


def layout(random: np.random.Generator, count: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Stickers on a bumpy dome of 200 mm, none nearer to another than 15 mm."""
    points: list[np.ndarray[tuple[int], np.dtype[np.float64]]] = []
    while len(points) < count:
        x, y = random.uniform(-100, 100, 2)
        point = np.array([x, y, 60 - (x * x + y * y) / 300 + 8 * np.sin(x / 17)])
        if all(np.linalg.norm(point - other) > 15 for other in points):
            points.append(point)
    return np.array(points)


def motion_of(random: np.random.Generator) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=int(random.integers(2**31))).as_matrix()
    motion[:3, 3] = random.uniform(-1000, 1000, 3)
    return motion


@pytest.mark.parametrize("seed", range(12))
def test_a_third_missing_and_as_many_false_are_told_apart(seed: int) -> None:
    random = np.random.default_rng(seed)
    known, motion = layout(random, 30), motion_of(random)
    seen = random.permutation(30)[:20]
    found = known[seen] @ motion[:3, :3].T + motion[:3, 3] + random.normal(0, 0.05, (20, 3))
    false = layout(random, 10) @ motion[:3, :3].T + motion[:3, 3] + random.normal(0, 5, 3)
    mixed = random.permutation(30)
    matched = match_points(np.concatenate([found, false])[mixed], known, TOLERANCE_MM)
    true = {(int(place), int(seen[row])) for place, row in enumerate(mixed) if row < 20}
    pairs = set(zip(matched.found_rows.tolist(), matched.known_rows.tolist(), strict=True))
    assert true <= pairs
    assert len(pairs - true) <= 1  # a false one may stand on a sticker by chance
    assert np.abs(matched.found_from_known - motion).max() < 0.2


def test_a_motion_is_found_exactly_where_nothing_is_off() -> None:
    random = np.random.default_rng(3)
    known, motion = layout(random, 12), motion_of(random)
    assert np.abs(rigid_motion(known, known @ motion[:3, :3].T + motion[:3, 3]) - motion).max() < 1e-9


def test_a_mirrored_layout_is_not_matched() -> None:
    random = np.random.default_rng(4)
    known = layout(random, 20)
    with pytest.raises(InputError, match="no motion brings 8 of the 20"):
        match_points(known * (-1, 1, 1), known, TOLERANCE_MM)


def test_a_regular_layout_is_refused_as_ambiguous() -> None:
    angle = np.arange(8) * np.pi / 4
    ring = np.stack([50 * np.cos(angle), 50 * np.sin(angle), 0 * angle], axis=1)
    with pytest.raises(InputError, match="two motions fit: one brings 8 targets together, the other 8"):
        match_points(ring, ring, TOLERANCE_MM)


def test_another_object_is_refused() -> None:
    random = np.random.default_rng(5)
    with pytest.raises(InputError, match="no motion brings"):
        match_points(1.5 * layout(random, 15), layout(random, 15), 0.05)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="expected 4 or more on each side; 3 were found"):
        match_points(np.eye(3), np.zeros((9, 3)), TOLERANCE_MM)

"""Projection and small turns: right, and with the right derivatives."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens

from coupole.calibration.optics import project
from coupole.calibration.rotations import (
    between,
    inverses,
    moved_transforms,
    quaternion,
    rotation,
    rotation_vector,
)

STEP = 1e-6
unit = st.floats(-1, 1)
vectors = arrays(np.float64, 3, elements=st.floats(-3, 3))
lenses = st.tuples(unit, unit, unit, unit, unit).map(
    lambda k: np.array([900.0, 905.0, 400.0, 300.0, 0.2 * k[0], 0.1 * k[1], 0.01 * k[2], 0.01 * k[3], 0.1 * k[4]])
)
points = arrays(np.float64, 3, elements=unit).map(lambda p: p * (150.0, 120.0, 60.0) + (0.0, 0.0, 350.0))


@given(lenses, points)
def test_a_point_is_seen_where_browns_formulas_have_it(lens: Array, point: Array) -> None:
    true = TrueLens((lens[0], lens[1]), (lens[2], lens[3]), tuple(lens[4:]))
    assert np.allclose(project(point[None], lens).pixels[0], true.see(point), rtol=0, atol=1e-9)


@given(lenses, points)
def test_derivatives_are_those_of_small_differences(lens: Array, point: Array) -> None:
    seen = project(point[None], lens)
    for axis in range(3):
        step = STEP * 100 * np.eye(3)[axis]
        slope = (project((point + step)[None], lens).pixels - project((point - step)[None], lens).pixels)[0]
        assert np.allclose(seen.by_point[0, :, axis], slope / (2e2 * STEP), rtol=1e-5, atol=1e-6)
    for parameter in range(9):
        step = STEP * np.eye(9)[parameter]
        slope = (project(point[None], lens + step).pixels - project(point[None], lens - step).pixels)[0]
        assert np.allclose(seen.by_intrinsics[0, :, parameter], slope / (2 * STEP), rtol=1e-4, atol=1e-4)


@given(vectors)
def test_rotations_are_scipys(vector: Array) -> None:
    turn = rotation(vector)
    assert np.allclose(turn, Rotation.from_rotvec(vector).as_matrix(), atol=1e-13)
    assert np.allclose(rotation(rotation_vector(turn)), turn, atol=1e-12)
    assert np.isclose(np.linalg.norm(quaternion(turn)), 1.0)


@given(vectors, vectors, arrays(np.float64, 6, elements=unit))
def test_a_step_between_transforms_leads_from_one_to_the_other(turn: Array, shift: Array, step: Array) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(turn), 100 * shift
    assert np.allclose(between(pose, moved_transforms(pose, step)), step, atol=1e-9)
    assert np.allclose(inverses(pose[None])[0] @ pose, np.eye(4), atol=1e-9)

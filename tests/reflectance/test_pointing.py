"""Where pixels look, against a pinhole camera and a surface that are shaken many times."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.reflectance.extraction.pointing import STATED, Pointing, pointings

LENS = Intrinsics(2000.0, 2000.0, 319.5, 239.5)
BASE_FROM_CAMERA = np.array([[0.6, 0, 0.8, -640], [0, 1, 0, 20], [-0.8, 0, 0.6, -480], [0, 0, 0, 1.0]])
DISTANCE_MM = 800.0
MIDDLE_MM = BASE_FROM_CAMERA[:3, :3] @ [0, 0, DISTANCE_MM] + BASE_FROM_CAMERA[:3, 3]


def places() -> np.ndarray:
    """[n, 3] on a sheet that faces the camera."""
    across = np.random.default_rng(1).uniform(-40, 40, (300, 2))
    return (
        np.column_stack([across, np.full(300, DISTANCE_MM)]) @ BASE_FROM_CAMERA[:3, :3].T + BASE_FROM_CAMERA[:3, 3]
    )


@pytest.mark.parametrize(
    "uncertain", [{"camera_mm": 0.2}, {"camera_rad": 4e-4}, {"mesh_mm": 0.3}, {"mesh_rad": 5e-3}]
)
def test_a_step_of_camera_or_mesh_shifts_the_picture_as_in_a_pinhole_camera(uncertain: dict[str, float]) -> None:
    names = ("camera_mm", "camera_rad", "mesh_mm", "mesh_rad")
    sizes = np.repeat([uncertain.get(name, 0.0) for name in names], 3)
    found = Pointing((), np.diag(sizes**2), MIDDLE_MM).u_lateral_mm(LENS, BASE_FROM_CAMERA, places())
    random, squares = np.random.default_rng(2), []
    for _ in range(400):
        steps = sizes * random.standard_normal(12)
        turned = Rotation.from_rotvec(steps[9:]).apply(places() - MIDDLE_MM) + MIDDLE_MM + steps[6:9]
        axes = BASE_FROM_CAMERA[:3, :3] @ Rotation.from_rotvec(steps[3:6]).as_matrix()
        now = (turned - BASE_FROM_CAMERA[:3, 3] - steps[:3]) @ axes
        before = (places() - BASE_FROM_CAMERA[:3, 3]) @ BASE_FROM_CAMERA[:3, :3]
        apart = now[:, :2] / now[:, 2:] - before[:, :2] / before[:, 2:]
        squares.append(np.mean(np.sum((apart * DISTANCE_MM) ** 2, axis=1)) / 2)
    assert found == pytest.approx(np.sqrt(np.mean(squares)), rel=0.1)
    assert found > 0.05


def test_errors_that_move_camera_and_mesh_alike_shift_nothing() -> None:
    """As after a refinement, which cannot tell where in the base frame all of it stands."""
    alike = np.zeros((12, 12))
    alike[:3, :3] = alike[:3, 6:9] = alike[6:9, :3] = alike[6:9, 6:9] = np.eye(3)
    assert Pointing((), alike, MIDDLE_MM).u_lateral_mm(LENS, BASE_FROM_CAMERA, places()) < 1e-6


def test_hand_eye_lens_arm_and_mesh_are_in_it() -> None:
    whole = np.zeros((8, 8))
    prior = CameraPrior(LENS, ("cx", "cy"), np.eye(4), whole)
    (unstated,) = pointings(prior, BASE_FROM_CAMERA[None], MIDDLE_MM)
    least = unstated.u_lateral_mm(LENS, BASE_FROM_CAMERA, places())
    arm_mm = np.hypot(STATED.arm_mm, np.radians(STATED.arm_deg) * DISTANCE_MM)
    assert least == pytest.approx(np.hypot(arm_mm, STATED.mesh_mm), rel=0.02)
    for place, size, shift_mm in (
        (0, 0.5, 0.5 * DISTANCE_MM / LENS.fx / np.sqrt(2)),
        (2, 0.2, 0.2 / np.sqrt(2)),
    ):
        known = whole.copy()
        known[place, place] = size**2
        (one,) = pointings(CameraPrior(LENS, ("cx", "cy"), np.eye(4), known), BASE_FROM_CAMERA[None], MIDDLE_MM)
        more = one.u_lateral_mm(LENS, BASE_FROM_CAMERA, places())
        assert np.sqrt(more**2 - least**2) == pytest.approx(shift_mm, rel=0.02)

"""Both structures of arms, against published figures, the stand-ins' own chains and themselves."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from arms import KR10, UR5E, UR10E
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.joint_chain import JointChain, ParallelAxes, SphericalWrist, branches, link_frames, structure_of
from coupole.kinematics import forward, inverse
from coupole.motion.singularities import distances, reason
from coupole.plan.arm_description import ArmDescription
from sim.devices import kuka_kinematics, ur_arm

ALL = pytest.mark.parametrize("arm", [KR10, UR5E, UR10E], ids=lambda arm: arm.name)
URS = pytest.mark.parametrize("arm", [UR5E, UR10E], ids=lambda arm: arm.name)
STAND_INS = {
    "KR10 R1100 sixx": kuka_kinematics.flange_pose,
    "UR5e": partial(ur_arm.flange_pose, "ur5e"),
    "UR10e": partial(ur_arm.flange_pose, "ur10e"),
}
seeds = st.integers(0, 2**32 - 1)


def somewhere(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(-180.0, 180.0, 6)


def apart_deg(some: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Whole turns do not count."""
    apart: NDArray[np.float64] = np.abs((some - other + 180.0) % 360.0 - 180.0).max(axis=-1)
    return apart


@ALL
@given(seeds)
def test_the_flange_is_where_the_stand_ins_chain_has_it(arm: ArmDescription, seed: int) -> None:
    joints_deg = somewhere(seed)
    assert np.allclose(forward(arm.arm, joints_deg), STAND_INS[arm.name](joints_deg.tolist()), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("arm", "flange_mm"),
    [
        (UR5E, (-425 - 392.2, -133.3 - 99.6, 162.5 - 99.7)),
        (UR10E, (-612.7 - 571.55, -174.15 - 116.55, 180.7 - 119.85)),
    ],
    ids=["UR5e", "UR10e"],
)
def test_a_ur_with_all_angles_zero_is_stretched_out_as_its_table_adds_up(
    arm: ArmDescription, flange_mm: tuple[float, ...]
) -> None:
    pose = forward(arm.arm, np.zeros(6))
    assert np.allclose(pose[:3, 3], flange_mm, atol=1e-9)
    assert np.allclose(pose[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


@ALL
@given(seeds)
def test_every_branch_leads_to_the_pose_and_the_original_is_among_them(arm: ArmDescription, seed: int) -> None:
    joints_deg = somewhere(seed)
    pose = forward(arm.arm, joints_deg)
    found = np.array(branches(arm.arm.chain, pose))
    there = forward(arm.arm, found)
    assert np.abs(there[:, :3, 3] - pose[:3, 3]).max() < 1e-6
    assert np.abs(there[:, :3, :3] - pose[:3, :3]).max() < 1e-8
    assert apart_deg(found, joints_deg).min() < 1e-4


@ALL
@given(seeds)
def test_away_from_its_singularities_a_posture_differs_from_other_branches(arm: ArmDescription, seed: int) -> None:
    joints_deg = somewhere(seed)
    if reason(arm.arm, joints_deg):
        return
    found = np.array(branches(arm.arm.chain, forward(arm.arm, joints_deg)))
    assert len(found) in (2, 4, 6, 8)
    itself, nearest, *_ = sorted(apart_deg(found, joints_deg))
    assert itself < 1e-4
    assert nearest > 1.0


@URS
def test_a_ur_reaches_a_near_pose_in_eight_ways(arm: ArmDescription) -> None:
    pose = forward(arm.arm, (20.0, -100.0, 110.0, -60.0, 70.0, 30.0))
    assert len(branches(arm.arm.chain, pose)) == 8


@URS
@pytest.mark.parametrize("a5_deg", [0.0, 180.0])
def test_a_ur_with_a_stretched_wrist_is_no_dead_end(arm: ArmDescription, a5_deg: float) -> None:
    pose = forward(arm.arm, (20.0, -100.0, 110.0, -60.0, a5_deg, 30.0))
    found = np.array(branches(arm.arm.chain, pose))
    assert len(found)
    assert np.abs(forward(arm.arm, found) - pose).max() < 1e-6
    assert np.all(found[np.abs(np.sin(np.radians(found[:, 4]))) < 1e-6, 5] == 0.0)


@URS
def test_every_turn_that_a_urs_limits_allow_is_a_solution(arm: ArmDescription) -> None:
    joints_deg = (20.0, -100.0, 110.0, -60.0, 70.0, 30.0)
    found = inverse(arm.arm, forward(arm.arm, joints_deg))
    assert len(found) == 8 * 2**6
    assert np.abs(found - joints_deg).max(axis=1).min() < 1e-6
    assert np.abs(found - (380.0 - 720.0 + 0.0, 260.0, -250.0, 300.0, -290.0, -330.0)).max(axis=1).min() < 1e-6


@URS
def test_a_pose_within_the_urs_shoulder_has_no_solution(arm: ArmDescription) -> None:
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 50.0, 400.0)
    assert len(inverse(arm.arm, pose)) == 0


def test_both_structures_are_found() -> None:
    assert isinstance(structure_of(KR10.arm.chain), SphericalWrist)
    assert isinstance(structure_of(UR10E.arm.chain), ParallelAxes)


def turned(chain: JointChain, turn: dict[str, str], shift_mm: tuple[float, float, float]) -> JointChain:
    """The same chain in a base frame whose axes are called otherwise, with another flange."""
    sign = {"+": 1.0, "-": -1.0}

    def vector(v: tuple[float, ...]) -> tuple[float, float, float]:
        out = dict.fromkeys("xyz", 0.0)
        for name, value in zip("xyz", v, strict=True):
            out[turn[name][1]] += sign[turn[name][0]] * value
        return out["x"], out["y"], out["z"]

    def axis(a: str) -> str:
        to = turn[a[1]]
        return ("+" if a[0] == to[0] else "-") + to[1]

    flange = np.array(chain.link_6_from_flange)
    columns = np.array([vector(tuple(row)) for row in flange[:3].T]).T
    columns[:, 3] += shift_mm
    rows = (*(tuple(row) for row in columns.tolist()), (0.0, 0.0, 0.0, 1.0))
    return JointChain(
        tuple(vector(o) for o in chain.origins_mm),
        tuple(axis(a) for a in chain.axes),  # type: ignore[arg-type]
        rows,
    )


@pytest.mark.parametrize(
    ("arm", "turn"),
    [
        (UR10E, {"x": "+y", "y": "+z", "z": "+x"}),
        (UR5E, {"x": "-x", "y": "-y", "z": "+z"}),
        (UR5E, {"x": "+x", "y": "-y", "z": "-z"}),
        (KR10, {"x": "-x", "y": "-y", "z": "+z"}),
    ],
)
@given(seed=seeds)
def test_a_chain_with_other_axes_and_another_flange_is_solved_too(
    arm: ArmDescription, turn: dict[str, str], seed: int
) -> None:
    chain = turned(arm.arm.chain, turn, (11.0, -7.0, 30.0))
    joints_deg = somewhere(seed)
    pose = link_frames(chain, joints_deg)[7]
    found = np.array(branches(chain, pose))
    assert np.abs(link_frames(chain, found)[:, 7] - pose).max() < 1e-6
    assert apart_deg(found, joints_deg).min() < 1e-4


@pytest.mark.parametrize(
    "change",
    [
        {"axes": ("+z", "+y", "+z", "+y", "+z", "+y")},
        {"origins_mm": ((0, 0, 400), (25, 0, 0), (560, 0, 0), (0, 0, 35), (515, 0, 0), (80, 10, 20))},
    ],
    ids=["no two axes parallel", "no wrist in a point"],
)
def test_a_chain_of_neither_structure_is_known_for_none(change: dict[str, object]) -> None:
    chain = replace(KR10.arm.chain, **change)  # type: ignore[arg-type]
    assert structure_of(chain) is None
    with pytest.raises(ValueError, match="neither a spherical wrist nor three parallel axes"):
        branches(chain, np.eye(4))


def jacobian(arm: ArmDescription, joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """[6, 6] of the flange's position (m) and orientation by the axes (rad), by differences."""
    columns = []
    for axis in range(6):
        step = np.degrees(1e-5) * np.eye(6)[axis]
        before, after = (forward(arm.arm, joints_deg + way * step) for way in (-1, 1))
        turn = after[:3, :3] @ before[:3, :3].T
        spin = np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2
        columns.append(np.concatenate([(after - before)[:3, 3] / 1000, spin]) / 2e-5)
    return np.array(columns).T


@pytest.mark.parametrize(
    ("arm", "links_m"), [(UR5E, 0.425 * 0.3922), (UR10E, 0.6127 * 0.57155)], ids=["UR5e", "UR10e"]
)
@given(seed=seeds)
def test_a_urs_jacobian_has_the_product_of_its_distances_from_singularities_as_determinant(
    arm: ArmDescription, links_m: float, seed: int
) -> None:
    joints_deg = somewhere(seed)
    wrist_deg, elbow_deg, shoulder_mm = distances(arm.arm, joints_deg)
    product = links_m * np.sin(np.radians(wrist_deg)) * np.sin(np.radians(elbow_deg)) * shoulder_mm / 1000
    assert abs(np.linalg.det(jacobian(arm, joints_deg))) == pytest.approx(product, abs=1e-6)


@URS
@pytest.mark.parametrize(
    ("joints_deg", "phrase"),
    [
        ((0, -100, 110, -60, 177, 30), "A5 3.0 deg from its singularity"),
        ((0, -100, -2, -60, 70, 30), "A3 2.0 deg from its singularity"),
    ],
)
def test_a_urs_singularities_are_named(arm: ArmDescription, joints_deg: tuple[float, ...], phrase: str) -> None:
    assert phrase in reason(arm.arm, joints_deg)


@URS
def test_the_urs_shoulder_is_singular_with_the_wrist_in_the_plane_of_axes_1_and_2(arm: ArmDescription) -> None:
    angles_deg = np.linspace(-120.0, -60.0, 6001)
    places = np.column_stack(
        [0 * angles_deg, angles_deg, *np.tile([[30.0], [-60.0], [70.0], [0.0]], len(angles_deg))]
    )
    over = places[int(np.argmin(distances(arm.arm, places)[2]))]
    assert "the plane of axes 1 and 2" in reason(arm.arm, over)
    pose = forward(arm.arm, over)
    crossing_mm = pose[:3, 3] - (99.6 if arm is UR5E else 116.55) * pose[:3, 2]
    assert abs(crossing_mm[0]) < 0.5  # A1 is 0: axis 2 lies along y

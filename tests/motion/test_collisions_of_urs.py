"""Distances of Universal Robots' arms against python-fcl, which gets capsules of its own on the stand-in's own
chain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from arms import UR5E, UR10E
from ur_checker import BASE_FROM_SUPPORT, BOX_MM, TOOL, Checker, moved, to_segment_mm

from coupole.geometry import apply
from coupole.motion.collisions import CellBodies, Clearances, Surroundings
from coupole.motion.sphere_tree import MESH_STEP_MM, surface_points
from coupole.plan.arm_description import ArmDescription
from sim.devices.arm_bodies import ur_capsules
from sim.devices.ur_arm import UrModel

ROUNDED_MM = 2.5
"""Spheres stand up to 1 mm out of the capsules that they stand for, on both sides."""
URS = pytest.mark.parametrize(("model", "arm"), [("ur5e", UR5E), ("ur10e", UR10E)], ids=["UR5e", "UR10e"])


def cell(arm: ArmDescription) -> CellBodies:
    import trimesh

    box = trimesh.creation.box(extents=BOX_MM)
    corners = box.vertices[box.faces] + (0, 0, BOX_MM[2] / 2)
    around = Surroundings(BASE_FROM_SUPPORT, 740.0, 1500.0, 74.0, surface_points(corners))
    return CellBodies(arm, around, TOOL, Clearances(0.0, 0.0, 0.0, 0.0, 0.0))


def trimmed(arm: ArmDescription) -> set[tuple[str, str]]:
    """Pairs of which only a part is kept apart: what the checker measures is less."""
    pairs = {(pair.body, pair.other) for pair in arm.kept_apart if pair.near_by_design_deg}
    return pairs | {(body.body, other) for name, other in pairs if name == "tool" for body in TOOL}


@URS
def test_no_pair_is_said_to_be_farther_apart_than_the_checker_finds(
    model: UrModel, arm: ArmDescription, scale: Callable[[int, int], int]
) -> None:
    low, high = np.array(arm.posture_limits_deg).T
    bodies, checker, random = cell(arm), Checker(model), np.random.default_rng(11)
    loose_mm: dict[bool, list[float]] = {True: [], False: []}
    touching = 0
    for joints in random.uniform(low, high, (scale(300, 5000), 6)):
        checker.place(joints)
        for (body, name), margin in bodies.margins(joints).items():
            other = name.removeprefix("the arm's ")
            of_the_arm = other != name
            if not (of_the_arm or other == "the object") or (body, other) in trimmed(arm):
                continue
            ours_mm, theirs_mm = float(margin[0]), checker.distance_mm(body, other)
            if theirs_mm < 0.0:
                touching += 1
                assert ours_mm < 0.0, (body, other, joints)
            else:
                assert ours_mm <= theirs_mm + 1e-3, (body, other, joints)
                loose_mm[of_the_arm].append(theirs_mm - ours_mm)
    assert touching > 100
    assert max(loose_mm[True]) < ROUNDED_MM
    assert max(loose_mm[False]) < ROUNDED_MM + MESH_STEP_MM


@URS
def test_the_described_bodies_enclose_the_stand_ins(model: UrModel, arm: ArmDescription) -> None:
    """Two pictures of one arm: the stand-in's is the smaller one, but for edges of its coarser parts."""
    random = np.random.default_rng(5)
    directions = random.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    joints = np.array((10.0, -120.0, 100.0, -60.0, 80.0, 20.0))
    moves = moved(model, joints)
    ends = [
        (*apply(moves[link], ends_mm), radius_mm)
        for name, parts in Checker(model).bodies.items()
        if name not in {body.body for body in TOOL}
        for link, ends_mm, radius_mm, _ in parts
    ]
    for capsule in ur_capsules(model, joints.tolist()):
        points = capsule[:3] + random.random((4000, 1)) * (capsule[3:6] - capsule[:3]) + capsule[6] * directions
        off_mm = np.min([to_segment_mm(points, a, b) - radius_mm for a, b, radius_mm in ends], axis=0)
        assert np.quantile(off_mm, 0.85) <= 0.0
        assert off_mm.max() < 20.0

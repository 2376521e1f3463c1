"""Random plans replayed against an independent checker: what preflight lets pass touches nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from arms import KR10, UR5E, UR10E
from places import REPO, SHARED_DATA

from coupole.kinematics import link_frames
from coupole.plan.arm_description import ArmDescription

ROOT = REPO
LINK_MESHES = SHARED_DATA / "robot/kr10r1100sixx"


@pytest.fixture(autouse=True)
def tools(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    yield
    for name in ("replay_plans", "replay_cell"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("arm", "plans"),
    [
        ("kr10", 10),
        pytest.param("ur5e", 20, marks=pytest.mark.full),
        pytest.param("ur10e", 10, marks=pytest.mark.full),
    ],
)
def test_random_plans_that_pass_touch_nothing(arm: str, plans: int, scale: Callable[[int, int], int]) -> None:
    """Of fewer plans than these, too few pass to say anything."""
    import replay_plans

    meshes = LINK_MESHES if arm == "kr10" and LINK_MESHES.is_dir() else None
    found = replay_plans.run(scale(plans, 500), 1, meshes, ROOT / f"configs/rigs/{replay_plans.RIGS[arm]}.yaml")
    assert found["touches"] == []
    assert found["passed"] >= 3
    assert sum(found["refused"].values()) == found["plans"] - found["passed"]


@pytest.mark.parametrize("arm", [KR10, UR5E, UR10E], ids=lambda arm: arm.name)
def test_the_checkers_chain_of_joints_agrees_with_ours(arm: ArmDescription) -> None:
    from replay_cell import ARMS, link_poses

    joints_deg = np.random.default_rng(1).uniform(-100, 100, (50, 6))
    assert np.allclose(link_poses(joints_deg, ARMS[arm.name]), link_frames(arm.arm, joints_deg), atol=1e-9)


def test_the_checker_sees_an_arm_in_the_object_the_support_and_the_dome() -> None:
    from coupole.preflight.job import read_job
    from replay_cell import ReplayCell

    cell = ReplayCell(read_job(ROOT / "configs/plans/demo.yaml"), None)
    places = {
        "the dome": (0, 0, 0, 0, 60, 0),
        "the support": (0, -90, 0, 0, 60, 0),
        "the object": (0, -110, 45, 0, 60, 0),
    }
    for other, joints_deg in places.items():
        touched = {touch.other for touch in cell.touches(np.array([joints_deg], dtype=np.float64))}
        assert other in touched
    assert cell.touches(np.array([(0.0, -170.0, 150.0, 0.0, -70.0, 0.0)])) == []

"""Random plans replayed against an independent checker: what preflight lets pass touches nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from places import REPO

from coupole.kinematics import link_frames

ROOT = REPO
LINK_MESHES = ROOT.parent / "shared/data/robot/kr10r1100sixx"


@pytest.fixture(autouse=True)
def tools(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    yield
    for name in ("replay_plans", "replay_cell"):
        sys.modules.pop(name, None)


def test_random_plans_that_pass_touch_nothing(scale: Callable[[int, int], int]) -> None:
    import replay_plans

    found = replay_plans.run(scale(20, 500), 1, LINK_MESHES if LINK_MESHES.is_dir() else None)
    assert found["touches"] == []
    assert found["passed"] >= 3
    assert sum(found["refused"].values()) == found["plans"] - found["passed"]


def test_the_checkers_chain_of_joints_agrees_with_ours() -> None:
    from replay_cell import link_poses

    joints_deg = np.random.default_rng(1).uniform(-100, 100, (50, 6))
    assert np.allclose(link_poses(joints_deg), link_frames(KR10_R1100_SIXX, joints_deg), atol=1e-9)


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

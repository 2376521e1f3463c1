"""Descriptions of arms: what is wrong is said at its place; those shipped are the makers'; a rig names its own."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import KR10, UR5E, UR10E
from places import REPO
from ruamel.yaml import YAML

from coupole.errors import InputError
from coupole.motion.itinerary import arm_of
from coupole.plan.arm_description import ArmDescription, read_arm, shipped_arm
from coupole.plan.cell import Cell, read_cell
from coupole.plan.rig_devices import described_arm
from coupole.preflight.job import read_job

ROBOTS = REPO / "configs/robots"
SHIPPED = (REPO / "configs/rigs/sim.yaml").read_text().replace("../", f"{REPO}/configs/")


def described(change: Callable[[dict[str, Any]], None], name: str = "ur10e") -> dict[str, Any]:
    data: dict[str, Any] = YAML(typ="safe", pure=True).load(ROBOTS / f"{name}.yaml")
    change(data)
    return data


def rig_with(folder: Path, **keys: str) -> Cell:
    (folder / "rig.yaml").write_text("".join(f"{key}: {value}\n" for key, value in keys.items()) + SHIPPED)
    return read_cell(folder / "rig.yaml")


@pytest.mark.parametrize("path", sorted(ROBOTS.glob("*.yaml")), ids=lambda path: path.stem)
def test_each_shipped_description_is_read_and_names_its_sources(path: Path) -> None:
    assert read_arm(path).joints
    text = path.read_text()
    assert "Origins and axes:" in text
    assert "Enclosing the collision meshes" in text


@pytest.mark.parametrize(
    ("arm", "table_mm", "top_deg_s"),
    [
        (UR5E, (162.5, -425.0, -392.2, 133.3, 99.7, 99.6), (180,) * 6),
        (UR10E, (180.7, -612.7, -571.55, 174.15, 119.85, 116.55), (120, 120, 180, 180, 180, 180)),
    ],
    ids=["UR5e", "UR10e"],
)
def test_a_urs_lengths_and_speeds_are_those_that_universal_robots_publishes(
    arm: ArmDescription, table_mm: tuple[float, ...], top_deg_s: tuple[float, ...]
) -> None:
    d1, a2, a3, d4, d5, d6 = table_mm
    origins = [joint.origin_mm for joint in arm.joints]
    assert origins == [(0, 0, d1), (0, 0, 0), (a2, 0, 0), (a3, 0, 0), (0, -d4, 0), (0, 0, -d5)]
    assert arm.link_6_from_flange.translation_mm == (0, -d6, 0)
    assert arm.arm.velocity_deg_s == top_deg_s
    assert set(arm.arm.limits_deg) == {(-360.0, 360.0)}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d["joints"][1].update(axis="up"), "joints[1].axis: "),
        (
            lambda d: d["joints"][1].update(limits_deg=[10, -10]),
            "joints[1].limits_deg: expected the lower limit first",
        ),
        (
            lambda d: d["joints"][2].update(posture_limits_deg=[-400, 10]),
            "joints[2].posture_limits_deg: expected a part of the joint's limits, -360 to 360 deg",
        ),
        (lambda d: d["joints"][4].update(origin_mm=[30, 0, 0]), "joints: no closed solution for this chain"),
        (lambda d: d["joints"].pop(), "joints: "),
        (
            lambda d: d["links"][2].update(name="base"),
            "links[2].name: expected a different name for each link; `base` is taken",
        ),
        (lambda d: d["links"].pop(5), "links: expected a body for each link, there is none of link 5"),
        (lambda d: d["links"][1]["capsules"][0].update(radius_mm=0), "links[1].capsules[0].radius_mm: "),
        (
            lambda d: d["kept_apart"].append({"body": "hand", "other": "base"}),
            "expected a body of `links` or `tool`, there is no `hand`",
        ),
        (
            lambda d: d["kept_apart"].append({"body": "shoulder", "other": "wrist 1"}),
            "other: expected a body nearer to the base than `shoulder`",
        ),
        (lambda d: d.update(reach=3), "unknown key"),
    ],
)
def test_what_is_wrong_is_said_at_its_line(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], says: str
) -> None:
    (tmp_path / "arm.yaml").write_text(json.dumps(described(change), indent=1))
    with pytest.raises(InputError) as caught:
        read_arm(tmp_path / "arm.yaml")
    assert any(says in str(problem) and problem.line > 0 for problem in caught.value.problems), caught.value


def test_a_rig_without_an_arm_is_that_of_its_driver() -> None:
    assert described_arm(read_cell(REPO / "configs/rigs/sim.yaml").rig) == KR10
    assert described_arm(read_cell(REPO / "configs/rigs/sim-eki.yaml").rig) == KR10


def test_a_ur_without_an_arm_is_that_of_its_model(tmp_path: Path) -> None:
    text = SHIPPED.replace("drivers.kuka.rsi:KukaRsi", "drivers.ur:UrRobot\n  settings: {model: ur5e}")
    text = text.replace("    robot: {cycle_ms: 4}\n", "")  # of the stand-in for RSI
    (tmp_path / "rig.yaml").write_text(text)
    assert described_arm(read_cell(tmp_path / "rig.yaml").rig) == UR5E
    (tmp_path / "rig.yaml").write_text(text.replace("ur5e", "ur3e"))
    with pytest.raises(
        InputError, match=r"rig\.yaml:\d+:\d+: robot\.settings\.model: .*expected one of kr10_r1100_sixx"
    ):
        read_cell(tmp_path / "rig.yaml")


def test_a_rig_names_an_arm_of_its_own_relative_to_itself(tmp_path: Path) -> None:
    data = described(lambda d: d.update(name="mine", link_meshes=None), "kr10_r1100_sixx")
    data["joints"][0]["posture_limits_deg"] = [-90, 100]
    (tmp_path / "mine.yaml").write_text(json.dumps(data))
    cell = rig_with(tmp_path, arm="mine.yaml")
    arm = arm_of(cell.rig)
    assert arm.name == "mine"
    assert arm.limits_deg[0] == (-90.0, 100.0)


def test_a_description_may_stand_in_the_rig_itself(tmp_path: Path) -> None:
    data = described(lambda d: d.update(name="mine"), "kr10_r1100_sixx")
    assert described_arm(rig_with(tmp_path, arm=json.dumps(data)).rig).name == "mine"  # type: ignore[union-attr]
    data["joints"][0]["limits_deg"] = [10, -10]
    with pytest.raises(
        InputError, match=r"rig\.yaml:1:\d+: arm\.joints\[0\]\.limits_deg: expected the lower limit"
    ):
        rig_with(tmp_path, arm=json.dumps(data))


@pytest.mark.parametrize(
    ("arm", "says"),
    [
        ("nowhere.yaml", r"rig\.yaml:1:6: arm: expected the arm's file; there is no .*nowhere\.yaml"),
        ("5", r"rig\.yaml:1:6: arm: expected "),
        ("{}", r"rig\.yaml:1:6: arm\.\w+: missing key"),
    ],
)
def test_a_rig_with_no_such_arm_is_refused_at_that_line(tmp_path: Path, arm: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        rig_with(tmp_path, arm=arm)


def test_an_arm_that_rsi_cannot_steer_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected an arm with a spherical wrist, as KUKA's have; UR10e has none"):
        rig_with(tmp_path, arm=str(ROBOTS / "ur10e.yaml"))


def test_an_arm_that_the_stand_in_does_not_move_is_planned_with_but_not_simulated(tmp_path: Path) -> None:
    data = described(lambda d: d.update(name="mine"), "kr10_r1100_sixx")
    data["joints"][2]["origin_mm"] = [455, 0, 0]
    (tmp_path / "mine.yaml").write_text(json.dumps(data))
    with pytest.raises(
        InputError, match=r"rig\.yaml:1:\d+: arm: expected the chain of a KR10 .*found the chain of `mine`"
    ):
        rig_with(tmp_path, arm="mine.yaml")
    real = (REPO / "configs/rigs/la-coupole.yaml").read_text().replace("../", f"{REPO}/configs/")
    (tmp_path / "rig.yaml").write_text("arm: mine.yaml\n" + real)
    assert arm_of(read_cell(tmp_path / "rig.yaml").rig).name == "mine"


def test_an_arms_link_meshes_are_sought_beside_its_file(tmp_path: Path) -> None:
    data = described(lambda d: d.update(link_meshes="meshes"), "kr10_r1100_sixx")
    (tmp_path / "mine.yaml").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"arm: expected the links' meshes; there is no .*meshes/base_link\.stl"):
        rig_with(tmp_path, arm="mine.yaml")


def test_no_arm_of_another_name_is_shipped() -> None:
    shipped = sorted(path.stem for path in ROBOTS.glob("*.yaml"))
    with pytest.raises(
        InputError, match=f"no description of the arm `kr6`.*expected one of {', '.join(shipped)};"
    ):
        shipped_arm("kr6")


def test_durations_follow_the_speeds_that_a_description_has(tmp_path: Path) -> None:
    data = described(lambda d: [joint.update(speed_deg_s=20) for joint in d["joints"]], "kr10_r1100_sixx")
    (tmp_path / "slow.yaml").write_text(json.dumps(data))
    cell = rig_with(tmp_path, arm="slow.yaml")
    assert np.allclose(arm_of(cell.rig).velocity_deg_s, 0.3 * 20.0)
    demo = REPO / "configs/plans/demo.yaml"
    slow, fast = (
        job.motion.itinerary(job.schedule.views, job.cell.rig.motion.home_joints_deg)
        for job in (read_job(demo, tmp_path / "rig.yaml"), read_job(demo))
    )
    durations_s = [sum(visit.leg.duration_s for visit in found.visits if visit) for found in (slow, fast)]
    assert durations_s[0] > 3 * durations_s[1]

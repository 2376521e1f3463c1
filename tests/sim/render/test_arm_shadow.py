"""Shadows of arm and tool."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_picture import ABOVE, photographer

from sim.devices import ur_arm
from sim.devices.arm_bodies import NONE, Capsules, ToolBody, arm_capsules, tool_capsules, ur_capsules
from sim.devices.camera_body import Exposed
from sim.devices.kuka_kinematics import flange_pose
from sim.devices.ur_arm import UrModel
from sim.render.arm_shadow import cast, distance_mm

points = st.tuples(*[st.floats(-500, 500)] * 3).map(np.array)


@settings(max_examples=200)
@given(points, points, points, points)
@example(*map(np.array, ([5.0, 0.0, 0.0], [0.0, 1.67e-5, 0.0], [0.0, 1.67e-5, 0.0], [4.0, 0.0, 0.0])))
def test_the_distance_of_segments_is_that_of_the_nearest_of_many_points(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray
) -> None:
    share = np.linspace(0.0, 1.0, 201)[:, None]
    on_first, on_second = a + share * (b - a), c + share * (d - c)
    sampled = np.linalg.norm(on_first[:, None] - on_second[None], axis=2).min()
    found = distance_mm(a, b, c, d)
    lengths = np.linalg.norm(b - a) + np.linalg.norm(d - c)
    assert found <= sampled + 1e-6 * (1 + lengths)
    assert found >= sampled - 0.5 * lengths / 200 - 1e-6


def test_a_capsule_darkens_what_lies_behind_it_and_nothing_else() -> None:
    centroids = np.array([[x, 0.0, 0.0] for x in (-300.0, 0.0, 300.0)], np.float32)
    radiance = np.ones((3, 3), np.float32)
    cast(radiance, centroids, np.array([[0.0, -50.0, 500.0, 0.0, 50.0, 500.0, 40.0]]), np.array([0.0, 0, 1000.0]))
    assert radiance[:, 0].tolist() == [1.0, 0.0, 1.0]


def test_the_order_of_the_points_decides_nothing() -> None:
    """Capsules are left out where they are far from a few hundred points together."""
    random = np.random.default_rng(4)
    points = random.uniform(-500.0, 500.0, (3000, 3)).astype(np.float32)
    ends = random.uniform(-500.0, 500.0, (40, 3))
    capsules = np.concatenate(
        [ends, ends + random.uniform(-90, 90, (40, 3)), random.uniform(5, 30, (40, 1))], axis=1
    )
    light = np.array([100.0, -50.0, 1200.0])
    scattered, sorted_by_place = (np.ones((3000, 3), np.float32) for _ in range(2))
    cast(scattered, points, capsules, light)
    order = np.lexsort((points[:, 1] // 250, points[:, 0] // 250))
    cast(sorted_by_place, points[order], capsules, light)
    assert np.array_equal(scattered[order], sorted_by_place)
    hidden = [
        any(distance_mm(p.astype(float), light, c[:3], c[3:6]) < c[6] for c in capsules) for p in points[:500]
    ]
    assert np.array_equal(scattered[:500, 0] == 0.0, hidden)
    assert 0.02 < np.mean(hidden) < 0.9


def test_the_camera_above_a_tile_takes_the_light_from_behind_it(tmp_path: Path) -> None:
    by = photographer(tmp_path)
    frames = []
    for arm in (NONE, np.array([[0.0, 0.0, 345.0, 0.0, 0.0, 500.0, 60.0]])):
        out = np.zeros((96, 128), np.uint16)
        by.render(out, Exposed({0: 0.004}, [], 0.004, 1.0, 1, ABOVE, arm))
        frames.append(out[36:60, 52:76].mean() - 64.0)
    assert frames[0] > 50.0
    assert abs(frames[1]) < 1.0


def test_the_arms_capsules_reach_from_the_column_to_the_flange() -> None:
    joints_deg = (10.0, -80.0, 95.0, 20.0, 40.0, -30.0)
    capsules: Capsules = arm_capsules(joints_deg)
    assert np.array_equal(capsules[:-1, 3:6], capsules[1:, :3])
    wrist_to_flange = np.linalg.norm(capsules[-1, 3:6] - flange_pose(joints_deg)[:3, 3])
    assert wrist_to_flange == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("model", get_args(UrModel))
def test_a_urs_capsules_reach_from_the_column_to_the_flange_without_a_gap(model: UrModel) -> None:
    joints_deg = (10.0, -80.0, 95.0, 20.0, 40.0, -30.0)
    capsules: Capsules = ur_capsules(model, joints_deg)
    assert np.array_equal(capsules[:-1, 3:6], capsules[1:, :3])
    to_flange_mm = np.linalg.norm(capsules[-1, 3:6] - ur_arm.flange_pose(model, joints_deg)[:3, 3])
    assert to_flange_mm == pytest.approx(capsules[-1, 6])
    assert np.all(np.linalg.norm(capsules[:, 3:6] - capsules[:, :3], axis=1) > 1.0)


def test_a_tool_goes_with_the_flange() -> None:
    base_from_flange = flange_pose((10.0, -80.0, 95.0, 20.0, 40.0, -30.0))
    tool = [ToolBody(from_mm=(0, 0, 20), to_mm=(0, 0, 100), radius_mm=60)]
    (capsule,) = tool_capsules(base_from_flange, tool)
    assert capsule[3:6] - capsule[:3] == pytest.approx(80.0 * base_from_flange[:3, 2])
    assert capsule[6] == 60.0
    assert tool_capsules(base_from_flange, []).shape == (0, 7)

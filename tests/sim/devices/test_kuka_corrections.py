"""Corrections of RSI as the stand-in for a KUKA controller takes them, without a wire."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.geometry import rotation_from_abc
from sim.devices.kuka_controller import Settings
from sim.devices.kuka_corrections import Corrections
from sim.devices.kuka_kinematics import flange_pose, joints_near

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)


def sum_of(values: tuple[float, ...], **settings: object) -> Corrections:
    """A session begun at home, with one correction taken."""
    corrections = Corrections(Settings.model_validate(settings))
    corrections.begin(HOME_DEG)
    assert corrections.take(values)[1] == ""
    return corrections


def only(place: int, value: float) -> tuple[float, ...]:
    return (*(0.0,) * place, value, *(0.0,) * (5 - place))


def test_absolute_corrections_replace_each_other_and_relative_ones_add_up() -> None:
    for mode, a1_deg in (("absolute", 2.0), ("relative", 3.0)):
        axes_deg, fault = sum_of(only(0, 1.0), mode=mode).take(only(0, 2.0))
        assert fault == ""
        assert axes_deg == (a1_deg, *HOME_DEG[1:])


@pytest.mark.parametrize(
    ("mode", "hold_on", "a1_deg"),
    [
        ("absolute", None, 1.0),
        ("absolute", False, 0.0),
        ("relative", None, 1.0),
        ("relative", True, 2.0),
    ],
)
def test_holdon_says_what_a_cycle_without_answer_does(mode: str, hold_on: bool | None, a1_deg: float) -> None:
    axes_deg, _ = sum_of(only(0, 1.0), mode=mode, hold_on=hold_on).take(None)
    assert axes_deg[0] == a1_deg


def test_axiscorr_clamps_without_a_word_and_its_monitor_stops_rsi() -> None:
    clamps = {"axis_clamp_deg": (5.0,) * 6}
    axes_deg, fault = sum_of(only(1, 4.0), limits=clamps).take(only(1, 7.0))
    assert (axes_deg[1], fault) == (-85.0, "")
    _, fault = sum_of(only(1, 4.0), limits={"axis_monitor_deg": (5.0,) * 6}).take(only(1, 7.0))
    assert fault == "AXISCORRMON: correction of A2 by 7.000 deg"


def test_poscorr_clamps_without_a_word_and_its_monitor_stops_rsi() -> None:
    clamped, fault = sum_of(only(0, 4.0), corrects="pose", limits={"pose_clamp_mm": 5.0}).take(only(0, 7.0))
    assert fault == ""
    assert flange_pose(clamped)[0, 3] == pytest.approx(flange_pose(HOME_DEG)[0, 3] + 5.0)
    turned, fault = sum_of(only(3, 4.0), corrects="pose", limits={"pose_clamp_deg": 5.0}).take(only(3, 7.0))
    assert fault == ""
    assert np.allclose(flange_pose(turned)[:3, :3], rotation_from_abc(5, 0, 0) @ flange_pose(HOME_DEG)[:3, :3])
    _, fault = sum_of(only(2, 4.0), corrects="pose", limits={"pose_monitor_mm": 5.0}).take(only(2, 7.0))
    assert fault.startswith("POSCORRMON: correction by [0.0, 0.0, 7.0] mm")


@given(moved=st.tuples(*[st.floats(-80.0, 80.0)] * 3), turned=st.tuples(*[st.floats(-30.0, 30.0)] * 3))
def test_a_correction_of_the_pose_moves_in_base_axes_and_turns_about_them(
    moved: tuple[float, ...], turned: tuple[float, ...]
) -> None:
    here, there = flange_pose(HOME_DEG), flange_pose(sum_of((*moved, *turned), corrects="pose").take(None)[0])
    assert np.allclose(there[:3, 3], here[:3, 3] + moved, atol=1e-6)
    assert np.allclose(there[:3, :3], rotation_from_abc(*turned) @ here[:3, :3], atol=1e-9)


def test_a_pose_out_of_reach_stops_rsi() -> None:
    corrections = sum_of((0.0,) * 6, corrects="pose")
    assert "no solution" in corrections.take(only(0, 900.0))[1]


@given(st.tuples(*[st.floats(-20.0, 20.0)] * 6))
def test_inverse_kinematics_stays_with_the_axes_it_starts_from(away_deg: tuple[float, ...]) -> None:
    joints_deg = tuple(a + b for a, b in zip(HOME_DEG, away_deg, strict=True))
    found = joints_near(flange_pose(joints_deg), HOME_DEG)
    assert found is not None
    assert np.allclose(found, joints_deg, atol=1e-6)

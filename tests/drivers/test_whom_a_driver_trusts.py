"""Whom a driver takes for its controller, and with what right it answers: the rig's, or a person's word."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from arms import KR10_R1100_SIXX
from places import REPO
from pydantic import ValidationError

from coupole.plan.cell import read_cell
from coupole.plan.rig_devices import trusted_by_name
from drivers.kuka import eki, rsi
from drivers.senders import only_here

RSI = {"arm_model": KR10_R1100_SIXX}
EKI = {"arm_model": KR10_R1100_SIXX, "controller_is": "client", "address": "0.0.0.0:54600"}


@pytest.mark.parametrize(
    ("driver", "settings"), [(rsi, RSI), (rsi, RSI | {"listen": "192.0.2.7:49152"}), (eki, EKI)]
)
def test_whoever_sends_first_is_not_taken_for_the_controller(driver: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=r"expected `controller`, the address.*any_controller_by: NAME"):
        driver.Settings(**settings)


@pytest.mark.parametrize(("driver", "settings"), [(rsi, RSI), (eki, EKI)])
@pytest.mark.parametrize("more", [{"controller": "192.0.2.20"}, {"any_controller_by": "A. Person"}])
def test_unless_the_rig_names_its_address_or_a_person_takes_it_upon_themselves(
    driver: Any, settings: dict[str, Any], more: dict[str, str]
) -> None:
    assert driver.Settings(**settings, **more)


@pytest.mark.parametrize(("driver", "settings"), [(rsi, RSI), (eki, EKI)])
def test_a_named_address_and_anybody_are_not_both_believed(driver: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="found both"):
        driver.Settings(**settings, controller="192.0.2.20", any_controller_by="A. Person")


@pytest.mark.parametrize(
    ("address", "here"),
    [("127.0.0.1:1", True), ("127.3.2.1:1", True), ("localhost:1", True), ("0.0.0.0:1", False), ("cell:1", False)],
)
def test_only_loopback_is_out_of_reach_of_others(address: str, here: bool) -> None:
    assert only_here(address) == here


_DROPS_THE_RIGHT = """
import ctypes, os, resource, sys
PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23
ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_SYS_NICE)  # of root; others do not have it
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
os.execv(sys.executable, [sys.executable, "-c", *sys.argv[1:]])
"""
_OPENS = """
import sys
from coupole.clock import SystemClock
from coupole.errors import DeviceError
from drivers.kuka.rsi.driver import KukaRsi, Settings

try:
    KukaRsi(Settings.model_validate_json(sys.argv[1]), SystemClock())
except DeviceError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize(
    ("listen", "more", "expected"),
    [
        ("0.0.0.0:0", {}, "DeviceRefused"),
        ("0.0.0.0:0", {"without_realtime_by": "A. Person"}, "DeviceTimeout"),
        ("127.0.0.1:0", {}, "DeviceTimeout"),
    ],
    ids=["on-the-network", "by-a-persons-word", "on-loopback"],
)
def test_without_the_right_to_real_time_priority_no_controller_on_the_network_is_answered(
    listen: str, more: dict[str, str], expected: str
) -> None:
    settings = rsi.Settings(**RSI, listen=listen, controller="192.0.2.20", connect_timeout_s=0.2, **more)
    ended = subprocess.run(
        [sys.executable, "-c", _DROPS_THE_RIGHT, _OPENS, settings.model_dump_json()],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ended.stdout.startswith(expected), ended
    if expected == "DeviceRefused":
        for word in ("setcap cap_sys_nice+ep", "limits.d", "LimitRTPRIO", "without_realtime_by: NAME"):
            assert word in ended.stdout


def test_a_persons_word_is_told_of_a_real_cell_and_never_of_a_simulated_one() -> None:
    cell = read_cell(REPO / "configs/rigs/la-coupole.yaml")
    robot = cell.rig.robot.model_copy(
        update={
            "driver": "drivers.kuka.rsi:KukaRsi",
            "settings": {"any_controller_by": "A. Person", "without_realtime_by": "B. Person"},
        }
    )
    real = cell.rig.model_copy(update={"robot": robot})
    assert trusted_by_name(real) == (
        "robot: the first sender is taken for the controller, by the word of A. Person",
        "robot: the arm may be answered at normal priority, by the word of B. Person",
    )
    simulated = read_cell(REPO / "configs/rigs/sim.yaml").rig.model_copy(update={"robot": robot})
    assert trusted_by_name(simulated) == ()

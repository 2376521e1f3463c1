"""Faults of a machine, made on purpose, are told by the driver that suffers from them, with their remedy."""

from __future__ import annotations

import os
import pty
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from arms import KR10_R1100_SIXX

from coupole.devices import HostNeed
from coupole.plan.cell import read_cell
from coupole.plan.shipped_files import SIMULATED_CELL
from coupole.preflight.machine import machine_needs
from drivers import host_checks
from drivers.camera.gentl.settings import Settings as GenTLSettings
from drivers.camera.raw.driver import Settings as RawSettings
from drivers.camera.xiapi.settings import Settings as XiSettings
from drivers.kuka.eki.settings import Settings as EkiSettings
from drivers.kuka.rsi.settings import Settings as RsiSettings
from drivers.ledbox import Settings as BoxSettings
from drivers.ledbox.text_lines import Settings as TextBoxSettings

ELSEWHERE = "192.0.2.7"
"""An address for documentation (RFC 5737): no machine has it."""


def unmet(needs: list[HostNeed]) -> HostNeed:
    (need,) = [need for need in needs if not need.is_met]
    return need


def needs_stored_in(folder: Path) -> list[HostNeed]:
    """Needs of the simulated cell with another folder of runs."""
    cell: Any = SimpleNamespace(rig=read_cell(SIMULATED_CELL).rig, storage_folder=folder)
    return [need for _, need in machine_needs(cell)]


def without_rights(imports: str, expression: str, *words: str) -> str:
    """What an expression is for a user without rights; `words` are sys.argv[1:]."""
    drop = "os.setgroups([]); os.setgid(65534); os.setuid(65534)" if os.geteuid() == 0 else ""
    program = f"import os, sys\n{imports}\n{drop}\nprint({expression})"
    command = [sys.executable, "-c", program, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    for settings in (BoxSettings(port=str(tmp_path / "ttyACM9")), TextBoxSettings(port="/dev/none", led_count=4)):
        need = unmet(settings.host_needs())
        assert need.is_vital
        assert "Connect the box" in need.remedy


def test_a_port_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "port").touch()
    assert unmet(BoxSettings(port=str(tmp_path / "port")).host_needs()).state == "is no device"


def test_a_port_that_this_user_may_not_use() -> None:
    master, slave = pty.openpty()
    port = Path(os.ttyname(slave))
    try:
        assert all(need.is_met for need in BoxSettings(port=str(port)).host_needs())
        port.chmod(0o000)
        told = without_rights(
            "from drivers.ledbox import Settings", "Settings(port=sys.argv[1]).host_needs()", str(port)
        )
    finally:
        os.close(master)
        os.close(slave)
    assert "this user may not use it" in told
    assert "usermod -aG" in told


def test_an_address_over_the_network_needs_no_port() -> None:
    assert BoxSettings(port=f"socket://{ELSEWHERE}:5000").host_needs() == []


def test_an_address_that_no_interface_has() -> None:
    rsi = RsiSettings(arm_model=KR10_R1100_SIXX, listen=f"{ELSEWHERE}:49152", controller="192.0.2.20")
    eki = EkiSettings(
        arm_model=KR10_R1100_SIXX, address=f"{ELSEWHERE}:54600", controller_is="client", controller="192.0.2.20"
    )
    for settings in (rsi, eki):
        (need,) = [need for need in settings.host_needs() if "address" in need.name]
        assert not need.is_met
        assert "no interface of this machine has this address" in need.state


def test_a_port_that_another_program_has() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        listen = f"127.0.0.1:{other.getsockname()[1]}"
        need = unmet(RsiSettings(arm_model=KR10_R1100_SIXX, listen=listen).host_needs())
    assert "another program" in need.state


def test_a_missing_right_to_real_time_priority() -> None:
    told = without_rights(
        "from coupole.plan.arm_description import shipped_arm\n"
        "from drivers.kuka.rsi.settings import Settings\n"
        "arm = shipped_arm('kr10_r1100_sixx').arm\n"
        "settings = Settings(arm_model=arm, listen='0.0.0.0:0', controller='192.0.2.20')",
        "[need for need in settings.host_needs() if not need.is_met]",
    )
    if "lacks the right" not in told and os.geteuid() != 0:
        pytest.skip("this user has the right, and nobody here can take it away")
    assert "lacks the right (SCHED_FIFO)" in told
    assert "setcap" in told


def test_a_library_of_the_maker_that_is_missing() -> None:
    need = next(need for need in XiSettings(library="libnone.so.7").host_needs() if not need.is_met)
    assert need.name == "library libnone.so.7"
    assert "XIMEA's software package" in need.remedy


def test_a_producer_that_is_missing(tmp_path: Path) -> None:
    need = unmet(GenTLSettings(producer=tmp_path / "maker.cti").host_needs())
    assert need.state == "there is no such file"
    assert "GENICAM_GENTL64_PATH" in need.remedy


def test_a_package_that_is_missing() -> None:
    need = host_checks.package("no_such_package", "gentl")
    assert (need.is_met, need.remedy) == (False, "Install it: pip install 'coupole[gentl]'.")


def test_a_folder_of_pictures_that_is_missing(tmp_path: Path) -> None:
    need = unmet(RawSettings(folder=tmp_path / "tethered", period_us=10**6).host_needs())
    assert need.state == "there is no such folder"


def test_a_receive_buffer_that_is_too_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for limit, is_met in ((212_992, False), (64 * 2**20, True)):
        (tmp_path / "rmem_max").write_text(f"{limit}\n")
        monkeypatch.setattr(host_checks, "_RECEIVE_LIMIT", tmp_path / "rmem_max")
        need = host_checks.receive_buffer()
        assert (need.is_met, need.is_vital) == (is_met, False)


def test_huge_pages_that_are_switched_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words, is_met in (("always madvise [never]", False), ("always [madvise] never", True)):
        (tmp_path / "enabled").write_text(f"{words}\n")
        monkeypatch.setattr(host_checks, "_HUGE_PAGES", tmp_path / "enabled")
        assert host_checks.huge_pages().is_met == is_met


def test_a_folder_of_runs_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "runs").touch()
    assert unmet(needs_stored_in(tmp_path / "runs")).state.endswith("is no folder")


def test_a_folder_of_runs_that_may_not_be_written() -> None:
    told = without_rights(
        "from pathlib import Path; from coupole.preflight.machine import storage_needs",
        "storage_needs(Path('/runs-of-nobody'))",
    )
    assert "this user may not write into /" in told
    assert "chown" in told

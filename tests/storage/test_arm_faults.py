"""Faults of an arm on disk, also when the disk or a power cut had its say."""

from __future__ import annotations

from pathlib import Path

import pytest

from coupole.errors import DeviceFault
from coupole.storage.arm_faults import ArmFaults

RIG = Path("rig.yaml")


def test_a_fault_stands_until_a_named_person_confirms_it(tmp_path: Path) -> None:
    faults = ArmFaults(tmp_path / "state")
    faults.refuse(RIG)
    faults.note("A3 left its path", run="a run")
    with pytest.raises(DeviceFault, match="A3 left its path"):
        ArmFaults(tmp_path / "state").refuse(RIG)
    faults.confirm("an operator")
    ArmFaults(tmp_path / "state").refuse(RIG)
    assert "A3 left its path (confirmed by an operator" in faults.begin_session("the next")
    assert faults.begin_session("the one after") == ""


TORN = (b'{"t":"2026-11-22T07:02:21.024Z","event":"fau', b"\0\0\0\0", b'{"event":"else"}')


@pytest.mark.parametrize("torn", TORN)
def test_a_line_that_cannot_be_read_counts_as_a_fault(tmp_path: Path, torn: bytes) -> None:
    """The power may have failed while the fault was written."""
    faults = ArmFaults(tmp_path)
    faults.note("A3 left its path")
    faults.confirm("an operator")
    with (tmp_path / "arm.jsonl").open("ab") as file:
        file.write(torn)
    with pytest.raises(DeviceFault, match="cannot be read"):
        faults.refuse(RIG)
    faults.confirm("an operator")
    faults.refuse(RIG)

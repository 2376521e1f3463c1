"""The fixture of a simulated cell, as others use it."""

from __future__ import annotations

from pathlib import Path

import pytest

import coupole
from coupole.testing import SimulatedCell


def test_devices_of_the_cell_are_opened_by_its_rig_and_seen_from_outside(simulated_cell: SimulatedCell) -> None:
    assert simulated_cell.look().is_safe
    with coupole.open_cell(simulated_cell.rig) as cell:
        cell.ledbox.flash(7, 2_000_000)
        assert simulated_cell.look().shining == (7,)
        assert not simulated_cell.look().is_safe
        assert cell.robot.measured().joints_deg == pytest.approx(simulated_cell.look().joints_deg, abs=0.01)
    assert simulated_cell.look().is_safe
    assert set(simulated_cell.light_given_s()) == {7}


class TestAnotherRig:
    """Fixtures that say what is simulated."""

    @pytest.fixture
    def simulated_rig(self) -> str:
        return "sim-text-dome"

    @pytest.fixture
    def simulated_speed(self) -> float:
        return 4.0

    def test_a_fault_happens_on_the_wire(self, simulated_cell: SimulatedCell) -> None:
        def flash_a_mute_box() -> None:
            with coupole.open_cell(simulated_cell.rig) as cell:
                simulated_cell.fault("mute_box", at_s=0.0)
                simulated_cell.clock.sleep(0.5)
                cell.ledbox.flash(3, 10_000)

        with pytest.raises(coupole.errors.DeviceError, match="led box"):
            flash_a_mute_box()
        with pytest.raises(ValueError, match="no_such_fault"):
            simulated_cell.fault("no_such_fault")

    def test_its_stand_ins_are_those_of_the_rig(self, simulated_cell: SimulatedCell, tmp_path: Path) -> None:
        assert coupole.Rig.read(simulated_cell.rig).ledbox.driver.endswith("TextLineBox")
        with coupole.open_cell(simulated_cell.rig) as cell:
            assert cell.identities["ledbox"].model == "text box"
        assert simulated_cell.rig.parent == tmp_path

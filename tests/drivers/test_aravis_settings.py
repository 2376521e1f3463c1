"""The Aravis driver's settings: what the reference says of them, and the shipped rig."""

from __future__ import annotations

import re

import pytest
from places import REPO
from pydantic import ValidationError

from coupole.plan.cell import read_cell
from coupole.plan.rig_devices import camera_kind
from drivers.camera.aravis.driver import Settings
from sim.devices.gige_registers import DESCRIPTION

ROOT = REPO


def test_the_reference_names_every_key() -> None:
    text = (ROOT / "docs/reference/camera-aravis.md").read_text(encoding="utf-8")
    assert [key for key in Settings.model_fields if key != "device" and f"`{key}`" not in text] == []


def test_the_shipped_rig_has_a_gige_camera_and_rehearses_without_one() -> None:
    rig = read_cell(ROOT / "configs/rigs/sim-gige.yaml").rig
    assert rig.camera.driver == "drivers.camera.aravis:AravisCamera"
    assert (camera_kind(rig, dry_run=False), camera_kind(rig, dry_run=True)) == ("gige", "memory")


@pytest.mark.parametrize(
    "wrong",
    [{"packet_size": 100}, {"features": {"Gain": [1]}}, {"region": {"width_px": 0, "height_px": 8}}, {"gain": 3}],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Settings.model_validate(wrong)


def test_what_the_simulated_camera_describes_is_there() -> None:
    """Every name that a node of the description points at is a node of it."""
    text = DESCRIPTION.read_text(encoding="utf-8")
    named = set(re.findall(r'<\w+ Name="(\w+)"', text))
    pointed = set(re.findall(r"<p(?:Feature|Value|Max|Selected|Port|Variable[^>]*)>(\w+)<", text))
    assert pointed <= named

"""Parts for tests of other projects: a simulated cell with its real protocols, and the contracts of devices as
classes.

This is a pytest plugin. Load it by name in the `conftest.py` of your tests' top folder:

::

    pytest_plugins = ["coupole.testing"]

The fixture `simulated_cell` is a running cell (`SimulatedCell`). The fixtures `simulated_rig` and
`simulated_speed` set its rig and its speed; override them in your own tests. Each class `...Conformance` tests the
contract of one kind of device: subclass it, and give it the fixtures that it names.
docs/how-to/test-your-driver.md shows both.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.register_assert_rewrite(
    *(
        f"coupole.testing.{name}"
        for name in (
            "camera_conformance",
            "camera_state_conformance",
            "ledbox_conformance",
            "robot_conformance",
            "table_box_conformance",
        )
    )
)

from coupole.testing.camera_conformance import CameraConformance, CameraWorld
from coupole.testing.camera_state_conformance import ForeignStateConformance, ForeignStateWorld
from coupole.testing.ledbox_conformance import LedBoxConformance, LedBoxWorld
from coupole.testing.robot_conformance import RobotCell, RobotConformance
from coupole.testing.simulated_cell import SeenFromOutside, SimulatedCell
from coupole.testing.simulated_cell import simulated_cell as started_cell
from coupole.testing.table_box_conformance import TableLedBoxConformance, TableLedBoxWorld

__all__ = [
    "CameraConformance", "CameraWorld", "ForeignStateConformance", "ForeignStateWorld", "LedBoxConformance",
    "LedBoxWorld", "RobotCell", "RobotConformance", "SeenFromOutside", "SimulatedCell", "TableLedBoxConformance",
    "TableLedBoxWorld", "simulated_cell", "simulated_rig", "simulated_speed", "started_cell",
]  # fmt: skip


@pytest.fixture
def simulated_rig() -> str | Path:
    """The rig whose stand-ins `simulated_cell` starts: a file, or the name of a shipped one (`sim`)."""
    return "sim"


@pytest.fixture
def simulated_speed() -> float:
    """Speed of `simulated_cell`, as a multiple of real time."""
    return 1.0


@pytest.fixture
def simulated_cell(tmp_path: Path, simulated_rig: str | Path, simulated_speed: float) -> Iterator[SimulatedCell]:
    """A running simulated cell with its real protocols; its process ends with the test."""
    with started_cell(tmp_path, simulated_rig, speed=simulated_speed) as cell:
        yield cell

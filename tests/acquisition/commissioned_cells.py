"""Cells for the tests of commissioning: few LEDs, a ball on the support, the camera above it; and who watches."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from cells import CellFolder
from numpy.typing import NDArray
from places import REPO

from coupole.acquisition.commissioning.bench import Bench
from coupole.acquisition.commissioning.reduced_speed import at_reduced_speed, greatest_speeds_deg_s
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell, open_cell
from coupole.motion.itinerary import bodies_of
from coupole.plan.cell import read_cell
from sim.devices.kuka_kinematics import flange_pose

ABOVE_THE_BALL_DEG = [-24.915, -124.799, 124.99, -9.088, -94.384, 24.551]
"""The camera 335 mm from the ball, at azimuth -90 and elevation 80 degrees."""
EVERY = 90
"""Of the dome's 1080 LEDs: 12."""


def ball_cell(folder: Path, *, speed: float, **world: Any) -> CellFolder:
    """A simulated cell as it is commissioned."""
    cell = CellFolder(folder, speed=speed, write_now=False)
    lines = [line for line in (REPO / "configs/domes/coupole.csv").read_text().splitlines() if line[0] != "#"]
    (folder / "dome.csv").write_text("\n".join([lines[0], *lines[1::EVERY]]) + "\n")
    cell.rig_data["dome"]["leds"] = "dome.csv"
    cell.rig_data["motion"] |= {"home_joints_deg": ABOVE_THE_BALL_DEG, "settle_dwell_s": 0.0}
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = 3
    cell.rig_data["world"]["settings"] |= {"things": [{"kind": "glossy_sphere", "diameter_mm": 80.0}], **world}
    cell.write()
    return cell


BOARD = """\
kind: charuco
corners: [7, 5]
square_mm: 10.0
marker_mm: 7.0
"""
BOARD_AT = {
    "kind": "charuco_board",
    "squares_x": 8,
    "squares_y": 6,
    "square_mm": 10.0,
    "marker_mm": 7.0,
    "translation_mm": [35.0, 5.0, 0.0],
}
BALL_AT = {"kind": "glossy_sphere", "diameter_mm": 50.0, "translation_mm": [-55.0, 0.0, 0.0]}


def board_cell(folder: Path, *, speed: float) -> CellFolder:
    """The same with a ball and a board side by side on the support, and pictures that are fine enough for it."""
    cell = ball_cell(folder, speed=speed, things=[BALL_AT, BOARD_AT])
    cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
    (folder / "board.yaml").write_text(BOARD)
    cell.write()
    return cell


def real(cell: CellFolder) -> None:
    """From now on the rig is that of a real cell: it names devices, and no world."""
    del cell.rig_data["world"]
    cell.rig_data["ledbox"]["settings"]["port"] = "/dev/nowhere"
    cell.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    cell.write()


@dataclass
class Onlooker:
    """A person who agrees to everything and sees everything as described; `heard` is all that was said."""

    heard: list[str] = field(default_factory=list)
    lengths_mm: dict[str, float] = field(default_factory=dict)
    """What a ruler says, by the question's name."""
    hold: Callable[[bool], None] = lambda _: None
    press: Callable[[], None] = lambda: None

    def is_ready(self, announcement: str) -> bool:
        self.heard.append(announcement)
        return True

    def confirms(self, question: str) -> bool:
        self.heard.append(question)
        return True

    def measures(self, quantity: str, question: str) -> float | None:
        self.heard.append(question)
        return self.lengths_mm.get(quantity)

    def tell(self, message: str) -> None:
        self.heard.append(message)

    def hold_enabling_switch(self, *, is_held: bool) -> None:
        self.hold(is_held)

    def press_emergency_stop(self) -> None:
        self.press()


class Eye(Onlooker):
    """A person who sees where the true camera goes, by the stand-in's kinematics, and compares the words."""

    def __init__(self, cell: CellFolder, true_joints_deg: Callable[[], list[float]]) -> None:
        super().__init__()
        self._true_joints_deg = true_joints_deg
        self._support = cell.rig_data["support"]["base_from_support"]
        self._before = self._camera()

    def is_ready(self, announcement: str) -> bool:
        self._before = self._camera()
        return super().is_ready(announcement)

    def confirms(self, question: str) -> bool:
        super().confirms(question)
        before, after = self._before, self._camera()
        # The support frame of the demo's rig: the base turned by half a turn about x.
        assert self._support["abc_deg"] == [0, 0, 180]
        way = (after[:3, 3] - before[:3, 3]) * [1, -1, -1]
        if found := re.search(r"azimuth (\d+) deg", question):
            said = np.radians(float(found[1]))
            if way[:2] @ [np.cos(said), np.sin(said)] < 0.9 * np.linalg.norm(way[:2]):
                return False
        if found := re.search(r"mm (up|down)", question):
            return bool((way[2] > 0) == (found[1] == "up"))
        if found := re.search(r"(counter-)?clockwise", question):
            axis = after[:3, 2]
            turned_right = float(np.cross(before[:3, 0], after[:3, 0]) @ axis) > 0
            return turned_right == (found[1] is None)
        return True

    def _camera(self) -> NDArray[np.float64]:
        pose: NDArray[np.float64] = flange_pose(tuple(self._true_joints_deg())).copy()
        pose[:3, 3] += 120.0 * pose[:3, 2]
        return pose


@contextmanager
def opened_bench(cell: CellFolder) -> Iterator[Bench]:
    """The cell's devices, opened at reduced speed, and somebody who agrees to everything."""
    read = read_cell(cell.rig)
    bodies = bodies_of(read.rig, read.leds, np.zeros((0, 3, 3)))
    slow = replace(read, rig=at_reduced_speed(read.rig, bodies))
    with open_cell(slow) as opened:
        yield Bench(slow, opened, bodies, greatest_speeds_deg_s(slow.rig), Onlooker(), Control())


class Wrapped:
    """A device with some of its methods replaced."""

    def __init__(self, device: Any, **replaced: Callable[..., Any]) -> None:
        self._device = device
        for name, method in replaced.items():
            setattr(self, name, method)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)


def with_devices(bench: Bench, **devices: Any) -> Bench:
    """The same bench with other devices in place of some."""
    opened: OpenedCell = replace(bench.opened, **devices)
    return replace(bench, opened=opened)

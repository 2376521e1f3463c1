"""What a burst does with the camera when the camera or the box is not as it should be."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from itertools import pairwise
from typing import Any
from unittest import mock

import cells
import pytest
from cells import CellFolder

from coupole.devices import Exposure, FrameFormat
from coupole.errors import DeviceRefused
from drivers.ledbox import LedBox
from sim.devices.memory_camera import MemoryCamera

CALLS = ("configure", "arm", "disarm", "close")


@contextlib.contextmanager
def recorded() -> Iterator[list[str]]:
    """The calls of the camera, in order, as the run makes them."""
    calls: list[str] = []

    def record(name: str) -> Any:
        original = getattr(MemoryCamera, name)

        def call(camera: MemoryCamera, *arguments: Any) -> Any:
            calls.append(name)
            return original(camera, *arguments)

        return mock.patch.object(MemoryCamera, name, call)

    with contextlib.ExitStack() as stack:
        for name in CALLS:
            stack.enter_context(record(name))
        yield calls


@pytest.mark.parametrize("wrong", [{"height_px": 128}, {"width_px": 96, "height_px": 128}])
def test_a_camera_whose_frames_have_another_size_than_the_rig_says_ends_the_run(
    cell: CellFolder, wrong: dict[str, int]
) -> None:
    """Before any frame, and without light; the second has the same number of bytes."""
    configure = MemoryCamera.configure

    def configure_wrongly(camera: MemoryCamera, exposure: Exposure) -> FrameFormat:
        return dataclasses.replace(configure(camera, exposure), **wrong)  # type: ignore[arg-type]

    with mock.patch.object(MemoryCamera, "configure", configure_wrongly), recorded() as calls:
        ended = cell.acquire()
    assert ended.code == 4, ended
    size = {"width_px": 128, "height_px": 96, **wrong}
    assert "camera: expected frames of 128 x 96, as the rig's `sensor:` says" in ended.err
    assert f"the camera makes {size['width_px']} x {size['height_px']}" in ended.err
    assert cells.frame_lines(cell.run_folder) == 0
    assert "arm" not in calls
    assert cells.events(cell.run_folder, "burst") == []


@pytest.mark.parametrize("error", [DeviceRefused, RuntimeError])
def test_the_camera_is_disarmed_if_the_box_does_not_start(cell: CellFolder, error: type[Exception]) -> None:
    """By the burst, not by the closing of the driver."""

    def start(box: LedBox, table: Any) -> None:
        if error is DeviceRefused:
            raise DeviceRefused("led box", expected="to start", happened="it does not", remedy="Mend it.")
        raise error("a defect")

    with mock.patch.object(LedBox, "start", start), recorded() as calls:
        ended = cell.acquire()
    assert ended.code == (4 if error is DeviceRefused else 1), ended
    assert calls.index("arm") < calls.index("disarm") < calls.index("close")


def test_the_camera_is_disarmed_before_a_burst_is_taken_again(cell: CellFolder) -> None:
    """After an arm that was pushed in the burst."""
    cell.write(lights={"kind": "every", "every": 4})
    cell.faults({"kind": "nudge_arm", "deg": 0.05, "seconds": 1.0, "at_edge": 60})
    with recorded() as calls:
        ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert [event["kind"] for event in cells.events(cell.run_folder, "fault")] == ["ArmMoved"]
    sessions = [call for call in calls if call in {"arm", "disarm"}]
    assert sessions.count("arm") >= 2
    assert all(after == "disarm" for call, after in pairwise(sessions) if call == "arm")

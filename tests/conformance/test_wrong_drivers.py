"""Drivers that break one promise each: the conformance classes find each of them out."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ledbox_world import ledbox_world
from places import REPO
from robot_cells import KukaCell
from test_camera_memory import MemoryWorld

from coupole.devices import CameraStatistics, Frame, Identity, StepRecord
from coupole.testing import CameraConformance, LedBoxConformance, RobotConformance, TableLedBoxConformance
from coupole.testing.camera_conformance import EXPOSURE
from drivers.kuka.rsi.driver import KukaRsi
from drivers.ledbox import LedBox, Settings
from sim.devices.memory_camera import MemoryCamera
from sim.world.ledbox_alone import LedBoxAlone, ledbox_alone

sys.path.insert(0, str(REPO / "docs/how-to/your_driver"))

import lumen_box
import test_lumen_box as lumen_world

FOUND_OUT = (AssertionError, pytest.fail.Exception)
"""What a test of a class ends with."""


def find_out(check: Callable[..., Any], *arguments: Any) -> None:
    """The check fails."""
    with pytest.raises(FOUND_OUT):
        check(*arguments)


# ---- LED boxes ----


class TakesTheLastLedForMissingOnes(lumen_box.LumenBox):
    def flash(self, led: int, on_us: int) -> None:
        super().flash(max(-1, min(led, self.led_count - 1)), on_us)


class BelievesInItsFlashForEver(lumen_box.LumenBox):
    def lit(self) -> bool:
        return self._flash is not None and self._flash.off_ns is None


class LeavesTheLightOn(lumen_box.LumenBox):
    def close(self) -> None:
        self._socket.shutdown(2)
        self._reader.join()
        self._socket.close()


class WaitsItsTurnToSwitchOff(lumen_box.LumenBox):
    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._lock = threading.RLock()  # type: ignore[assignment]

    def lights_off(self) -> None:
        with self._lock:
            super().lights_off()


class TellsHalfTheLight(lumen_box.LumenBox):
    def end_flash(self) -> StepRecord:
        record = super().end_flash()
        return replace(record, on_us=record.on_us / 2)


class CountsOnForEver(lumen_box.LumenBox):
    def end_flash(self) -> StepRecord:
        record, flash = super().end_flash(), self._flash
        assert flash is not None
        return replace(record, on_us=(self._clock.now_ns() - flash.sent_ns) / 1e3)


class AcknowledgesInTheLight(lumen_box.LumenBox):
    def acknowledge(self) -> None:
        self._ask(b"?")


class PassesForReal(lumen_box.LumenBox):
    def identify(self) -> Identity:
        return replace(super().identify(), simulated=False)


CONTRACT = LedBoxConformance()


@pytest.mark.parametrize(
    ("driver", "check"),
    [
        (TakesTheLastLedForMissingOnes, CONTRACT.test_an_led_that_it_does_not_have_is_refused_in_the_dark),
        (BelievesInItsFlashForEver, CONTRACT.test_a_flash_that_nobody_ends_goes_out_by_itself),
        (WaitsItsTurnToSwitchOff, CONTRACT.test_lights_off_from_another_thread_waits_for_no_call),
        (TellsHalfTheLight, CONTRACT.test_a_flash_lasts_as_long_as_was_asked_if_it_is_let),
        (CountsOnForEver, CONTRACT.test_a_flash_lasts_as_long_as_was_asked_if_it_is_let),
        (AcknowledgesInTheLight, CONTRACT.test_after_an_acknowledgement_all_is_dark),
    ],
)
def test_a_wrong_led_box_is_found_out(driver: type[Any], check: Callable[..., None], tmp_path: Path) -> None:
    with lumen(driver, tmp_path) as world, world.opener() as box:
        find_out(check, box, world)


def test_an_led_box_that_leaves_the_light_on_is_found_out(tmp_path: Path) -> None:
    with lumen(LeavesTheLightOn, tmp_path) as world:
        find_out(CONTRACT.test_closing_leaves_no_light, world)


def test_a_stand_in_that_passes_for_real_is_found_out(tmp_path: Path) -> None:
    with lumen(PassesForReal, tmp_path) as world, world.opener() as box:
        find_out(CONTRACT.test_it_says_who_it_is_and_whether_it_is_a_stand_in, box)


def lumen(driver: type[Any], folder: Path) -> Any:
    """The example's box with another driver."""

    def opened(world: LedBoxAlone) -> Any:
        return closing(driver(lumen_box.Settings(host="127.0.0.1", tcp_port=world.box.tcp_port), world.clock))

    return ledbox_alone(folder, lumen_world.stand_in, opened)


class LeavesThePanelOn(LedBox):
    def panel(self, panel: int, on: bool) -> None:
        if on:
            super().panel(panel, on)


def test_a_box_that_leaves_its_panel_on_is_found_out(tmp_path: Path) -> None:
    with (
        ledbox_world(tmp_path) as world,
        closing(LeavesThePanelOn(Settings(port=world.box.port, watchdog_s=20.0), world.clock)) as box,
    ):
        find_out(CONTRACT.test_each_of_its_panels_can_be_switched_off_alone, box, world)


class CountsAnEdgeTooMany(LedBox):
    def edges(self) -> int:
        return super().edges() + 1


class LosesALineOfTheLog(LedBox):
    def poll_log(self) -> Any:
        return super().poll_log()[1:]


@pytest.mark.parametrize("driver", [CountsAnEdgeTooMany, LosesALineOfTheLog])
def test_a_wrong_box_with_tables_is_found_out(driver: type[LedBox], tmp_path: Path) -> None:
    with (
        ledbox_world(tmp_path) as world,
        closing(driver(Settings(port=world.box.port, watchdog_s=20.0), world.clock)) as box,
    ):
        find_out(TableLedBoxConformance().test_a_burst_lights_each_led_and_sends_each_edge, box, world)


# ---- cameras ----


class CountsNoFrames(MemoryCamera):
    def next_frame(self, timeout_s: float) -> Frame | None:
        frame = super().next_frame(timeout_s)
        return None if frame is None else replace(frame, frame_id=1)


class HidesEarlyEdges(MemoryCamera):
    def statistics(self) -> CameraStatistics:
        return replace(super().statistics(), over_triggers=0)


class GivesFramesAwayTwice(MemoryCamera):
    def next_frame(self, timeout_s: float) -> Frame | None:
        frame = super().next_frame(timeout_s)
        if frame is not None:
            frame.release()
            frame.release = lambda: None
        return frame


@pytest.mark.parametrize(
    ("driver", "check"),
    [
        (CountsNoFrames, CameraConformance().test_frame_ids_count_on_by_one),
        (HidesEarlyEdges, CameraConformance().test_an_edge_that_comes_too_early_is_counted_and_makes_no_frame),
        (GivesFramesAwayTwice, CameraConformance().test_a_frame_keeps_its_pixels_until_it_is_released),
    ],
)
def test_a_wrong_camera_is_found_out(
    driver: type[MemoryCamera], check: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("test_camera_memory.MemoryCamera", driver)
    with closing(MemoryWorld(tmp_path)) as world:
        camera = world.open()
        camera.configure(EXPOSURE)
        find_out(check, camera, world)


# ---- robots ----


class DoesNotStop(KukaRsi):
    def stop(self) -> None:
        """Nothing."""


class AlwaysAtFullSpeed(KukaRsi):
    def move_to(self, joints_deg: Any, speed: float = 1.0) -> None:
        super().move_to(joints_deg, 1.0)


class SaysItStopsAtOnce(KukaRsi):
    def stopping_deg(self) -> Any:
        return np.zeros(6)


@pytest.fixture
def arm_cell(tmp_path: Path) -> Iterator[KukaCell]:
    with closing(KukaCell(tmp_path)) as cell:
        yield cell


@pytest.mark.parametrize(
    ("driver", "check"),
    [
        (DoesNotStop, RobotConformance().test_stop_in_mid_motion_brings_it_to_rest_smoothly),
        (AlwaysAtFullSpeed, RobotConformance().test_at_a_share_of_its_speeds_no_axis_is_faster),
        (SaysItStopsAtOnce, RobotConformance().test_after_stop_no_axis_turns_farther_than_it_says),
    ],
)
def test_a_wrong_robot_is_found_out(driver: type[KukaRsi], check: Callable[..., None], arm_cell: KukaCell) -> None:
    find_out(check, arm_cell, arm_cell.keep(driver(arm_cell.settings, arm_cell.clock)))

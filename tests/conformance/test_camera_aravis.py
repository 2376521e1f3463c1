"""What every Camera must do, run on the Aravis driver over real GigE Vision packets on loopback; and what this
driver and its stand-in must do besides."""

from __future__ import annotations

import json
import mmap
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_world import in_world, ramp
from gige import needs_aravis
from gige_world import SETTINGS, GigeWorld, arv_tool, gige_world

from coupole.errors import DeviceLost, DeviceRefused
from coupole.testing.camera_conformance import A_MOMENT_S, EXPOSURE, CameraConformance, take
from coupole.testing.camera_state_conformance import LEFT_BY_SFNC, ForeignStateConformance, Left
from drivers.camera.aravis.discovery import discover
from drivers.camera.aravis.driver import AravisCamera

pytestmark = needs_aravis


@pytest.fixture
def world(tmp_path: Path) -> Iterator[GigeWorld]:
    with gige_world(tmp_path) as world:
        yield world


class TestAravisCamera(CameraConformance):
    """The contract, over GigE Vision."""


@pytest.mark.skipif(shutil.which("arv-tool-0.8") is None, reason="arv-tool-0.8 is not installed")
class TestForeignState(ForeignStateConformance):
    """After Aravis's command line."""

    @pytest.fixture
    def world(self, tmp_path: Path) -> Iterator[GigeWorld]:
        with gige_world(tmp_path, render=ramp) as world:
            yield world

    @pytest.fixture(params=list(LEFT_BY_SFNC))
    def left(self, request: pytest.FixtureRequest) -> Left:
        return LEFT_BY_SFNC[request.param]

    @pytest.fixture
    def all_left(self) -> Mapping[str, Left]:
        return LEFT_BY_SFNC


# -- features -------------------------------------------------------------------------------------------------


def opened(world: GigeWorld, **settings: Any) -> AravisCamera:
    """Configured for edges and armed."""
    camera = world.open(**settings)
    camera.configure(EXPOSURE)
    camera.arm(32)
    return camera


def test_features_are_set_at_opening_and_a_region_is_read_out(world: GigeWorld) -> None:
    region = {"width_px": 16, "height_px": 8, "left_px": 4, "top_px": 2}
    camera = world.open(region=region, features={"AcquisitionFrameRate": 20.0, "TriggerActivation": "RisingEdge"})
    found = camera.configure(EXPOSURE)
    assert (found.height_px, found.width_px) == (8, 16)
    camera.arm(8)
    world.fire()
    (frame,) = take(camera, 1)
    assert frame.pixels.shape == (8, 16)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("NoSuchThing", 1, "a camera with the feature `NoSuchThing`"),
        ("Gain", 99.0, "0 to 24 for `Gain`; 99 was given"),
        ("Gain", "much", "a number for `Gain`"),
        ("Width", 10, "8 plus a multiple of 4 for `Width`"),
        ("Width", 12.5, "a whole number for `Width`"),
        ("TriggerSource", "Line7", "one of Line0, Software for `TriggerSource`"),
        ("AcquisitionStop", False, "`true` for the command `AcquisitionStop`"),
        ("ImageFormatControl", 1, "with a value"),
        ("SensorWidth", 4, "`SensorWidth` can only be read"),
    ],
)
def test_a_feature_that_cannot_be_set_is_named(world: GigeWorld, name: str, value: Any, words: str) -> None:
    with pytest.raises(DeviceRefused) as refused:
        world.open(features={name: value})
    assert words in str(refused.value)


def test_a_format_that_the_driver_does_not_know_is_refused(world: GigeWorld) -> None:
    with pytest.raises(DeviceRefused, match=r"one of BayerGB12, .* for `PixelFormat`"):
        world.open(pixel_format="YUV422")


@pytest.mark.parametrize(
    ("pixel_format", "bit_depth", "shown"),
    [
        ("BayerGB12p", 12, 3),
        ("Mono12Packed", 12, 3),
        ("BayerGB16", 16, 48),
        ("Mono8", 8, 0),
        ("BayerGB10p", 10, 0),
    ],
)
def test_pixels_of_each_kind_of_format_come_as_sixteen_bit_numbers(
    world: GigeWorld, pixel_format: str, bit_depth: int, shown: int
) -> None:
    camera = world.open(pixel_format=pixel_format)
    found = camera.configure(EXPOSURE)
    assert (found.bit_depth, found.white_dn) == (bit_depth, (1 << bit_depth) - 1)
    camera.arm(8)
    world.fire(10_000, 10_000, 10_000)
    last = take(camera, 4)[3]
    assert last.pixels.dtype == np.uint16
    assert last.pixels.ctypes.data % mmap.PAGESIZE == 0
    assert (last.pixels == shown).all()


def test_the_camera_tells_its_temperature(world: GigeWorld) -> None:
    camera = world.open()
    assert camera.self_test()["temperature_c"] == "41.5"


def test_without_counters_the_camera_does_not_guess(world: GigeWorld) -> None:
    camera = opened(world, exposed_counter=None, over_trigger_counter=None)
    world.fire(10_000, 1_000)
    take(camera, 2)
    found = camera.statistics()
    assert (found.exposed, found.over_triggers, found.delivered) == (-1, -1, 2)


# -- what gets lost ---------------------------------------------------------------------------------------------


def test_frame_ids_wrap_from_65535_to_1(tmp_path: Path) -> None:
    with gige_world(tmp_path, first_frame_id=65_533) as world:
        camera = opened(world)
        world.fire(*[10_000] * 5)
        assert [frame.frame_id for frame in take(camera, 6)] == [65_533, 65_534, 65_535, 1, 2, 3]
        assert camera.id_modulus == (1, 65_535)
        assert camera.statistics().lost_transfers == 0


def test_a_frame_lost_in_transfer_leaves_a_gap_in_the_ids(world: GigeWorld) -> None:
    world.camera.lose_frames.update({2, 3})
    camera = opened(world)
    world.fire(*[10_000] * 5)
    ids = [frame.frame_id for frame in take(camera, 4)]
    assert np.diff(ids).tolist() == [1, 3, 1]
    found = camera.statistics()
    assert (found.exposed, found.delivered, found.lost_transfers, found.overflows) == (6, 4, 2, 0)


def test_frames_that_lack_packets_are_counted_and_never_delivered(tmp_path: Path) -> None:
    with gige_world(tmp_path, height_px=96, width_px=128, lost_packets=0.01) as world:
        camera = opened(world, packet_size=1500)
        numbers = []
        world.fire(*[10_000] * 99)
        while (frame := camera.next_frame(A_MOMENT_S)) is not None:
            assert (frame.pixels == frame.pixels[0, 0]).all()
            numbers.append(int(frame.pixels[0, 0]))
            frame.release()
        found = camera.statistics()
        assert 0 < len(numbers) < 100
        assert numbers == sorted(set(numbers))
        assert found.delivered == len(numbers)
        assert 0 < found.lost_transfers <= 100 - len(numbers)


def test_frames_that_find_no_buffer_are_overflows(world: GigeWorld) -> None:
    camera = world.open(buffers=2)
    camera.configure(EXPOSURE)
    camera.arm(2)
    world.fire(*[10_000] * 5)
    threading.Event().wait(A_MOMENT_S)
    for frame in take(camera, 2):
        frame.release()
    world.fire()
    (late,) = take(camera, 1)
    assert int(late.pixels[0, 0]) == 6
    found = camera.statistics()
    assert (found.exposed, found.delivered, found.overflows, found.lost_transfers) == (7, 3, 4, 0)


# -- control ----------------------------------------------------------------------------------------------------


def test_a_camera_that_forgets_its_client_in_a_burst_is_lost(world: GigeWorld) -> None:
    camera = opened(world)
    world.fire()
    take(camera, 1)
    in_world(world.reactor, world.camera.lose_control)
    with pytest.raises(DeviceLost, match="camera: expected control of the camera"):
        camera.next_frame(30.0)
    with pytest.raises(DeviceLost):
        camera.disarm()
    camera.close()
    again = opened(world)
    world.fire()
    assert len(take(again, 1)) == 1


def test_a_camera_whose_client_was_killed_is_had_after_its_heartbeat(world: GigeWorld) -> None:
    script = (
        "import os, sys; from drivers.camera.aravis import AravisCamera, Settings;"
        "from coupole.clock import SystemClock; from coupole.devices import Exposure;"
        "camera = AravisCamera(Settings.model_validate_json(sys.argv[1]), SystemClock());"
        "camera.configure(Exposure(2000)); camera.arm(8); os.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", script, json.dumps(SETTINGS)], check=False, timeout=60)
    assert ended.returncode == -9
    camera = opened(world)
    world.fire()
    assert len(take(camera, 1)) == 1


def test_a_camera_is_found_by_its_serial_number(world: GigeWorld) -> None:
    assert any(found.serial == "SIM-1" and found.vendor == "Coupole" for found in discover())
    assert world.open(address="SIM-1").identify().simulated


def test_a_serial_number_that_no_camera_has_is_told_with_those_that_answer(world: GigeWorld) -> None:
    with pytest.raises(
        DeviceLost, match="expected one camera SIM-9; cameras that answer: Coupole DomeCamera SIM-1"
    ):
        world.open(address="SIM-9")


# -- other clients ----------------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("arv-tool-0.8") is None, reason="arv-tool-0.8 is not installed")
def test_an_independent_client_finds_the_camera_and_reads_its_features(world: GigeWorld) -> None:
    listed = subprocess.run(["arv-tool-0.8"], capture_output=True, text=True, check=True, timeout=60).stdout
    assert "Coupole-DomeCamera-SIM-1 (127.0.0.1)" in listed
    assert "BayerGB12p" in arv_tool("description", "PixelFormat") + arv_tool("features")
    values = arv_tool("control", "SensorWidth", "PixelFormat", "DeviceTemperature", "CounterEventSource")
    assert "SensorWidth = 40" in values
    assert "PixelFormat = BayerGB12" in values
    assert "DeviceTemperature = 41.5" in values
    assert "ExposureTime = 1234" in arv_tool("control", "ExposureTime=1234", "ExposureTime")


@pytest.mark.skipif(shutil.which("arv-camera-test-0.8") is None, reason="arv-camera-test-0.8 is not installed")
def test_an_independent_client_takes_frames(tmp_path: Path) -> None:
    with gige_world(tmp_path, height_px=384, width_px=512):
        command = ["arv-camera-test-0.8", "-n", SETTINGS["address"], "--duration", "3"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    completed = re.search(r"n_completed_buffers\s*=\s*(\d+)", ended.stdout)
    assert completed is not None, ended.stdout + ended.stderr
    assert int(completed[1]) > 10

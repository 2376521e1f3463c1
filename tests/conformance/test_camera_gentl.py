"""What every Camera must do, run on the GenTL driver over a producer of our own; and what is the driver's own."""

from __future__ import annotations

import logging
import signal
import socket
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gentl_camera import EXPOSURE_AUTO, OFFSET_X, OFFSET_Y, TRIGGER_MODE, TRIGGER_SOURCE
from gentl_world import SERIAL, GenTLWorld, camera_process, compile_producer, needs_compiler
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.devices import Exposure
from coupole.errors import DeviceLost, DeviceRefused
from coupole.testing.camera_conformance import EXPOSURE, PATIENCE_S, CameraConformance, take, take_numbers
from coupole.testing.camera_state_conformance import LEFT_BY_SFNC, ForeignStateConformance, Left
from drivers.camera.gentl.driver import GenTLCamera
from drivers.camera.gentl.producer import Gaps

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def producer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compile_producer(tmp_path_factory.mktemp("gentl"))


@pytest.fixture(scope="module")
def cameras() -> Iterator[Connection]:
    with camera_process() as cameras:
        yield cameras


@pytest.fixture
def character() -> dict[str, Any]:
    """What is special about the camera."""
    return {}


@pytest.fixture
def world(producer: Path, cameras: Connection, tmp_path: Path, character: dict[str, Any]) -> Iterator[GenTLWorld]:
    world = GenTLWorld(producer, cameras, tmp_path, **character)
    yield world
    world.close()


def armed(world: GenTLWorld, **settings: Any) -> GenTLCamera:
    """Opened, configured for edges, armed with few buffers unless the rig wants more."""
    camera = world.open(**settings)
    camera.configure(EXPOSURE)
    camera.arm(2)
    return camera


class TestGenTLCamera(CameraConformance):
    """The contract, over GenTL's functions."""


class TestForeignState(ForeignStateConformance):
    """After another program over harvesters."""

    @pytest.fixture
    def character(self) -> dict[str, Any]:
        return {"ramp": True}

    @pytest.fixture(params=list(LEFT_BY_SFNC))
    def left(self, request: pytest.FixtureRequest) -> Left:
        return LEFT_BY_SFNC[request.param]

    @pytest.fixture
    def all_left(self) -> Mapping[str, Left]:
        return LEFT_BY_SFNC


class TestLosses:
    """Whatever is lost leaves a gap in the ids or a count."""

    def test_an_image_lost_on_its_way_is_counted_and_leaves_a_gap(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.lose(1, 2)
        world.fire(*[10_000] * 3)
        ids = [frame.frame_id for frame in take(camera, 2)]
        found = camera.statistics()
        assert ids[1] - ids[0] == 3
        assert (found.exposed, found.delivered, found.lost_transfers) == (4, 2, 2)

    def test_an_image_that_comes_with_parts_missing_is_left_out_and_counted(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.tear(2)
        world.fire(*[10_000] * 2)
        assert take_numbers(camera, 2) == [0, 2]
        found = camera.statistics()
        assert (found.exposed, found.delivered, found.lost_transfers) == (3, 2, 1)

    def test_images_that_find_no_buffer_are_counted_as_overflows(self, world: GenTLWorld) -> None:
        camera = armed(world, buffers=3)
        world.fire(*[10_000] * 6)
        _wait_until_sent(world, 7)
        numbers = take_numbers(camera, 3)
        world.fire()
        numbers += take_numbers(camera, 1)
        found = camera.statistics()
        assert numbers == [0, 1, 2, 7]
        assert (found.exposed, found.delivered, found.overflows, found.lost_transfers) == (8, 4, 4, 0)

    def test_images_wait_in_the_producer_while_all_slots_are_in_hand(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.fire(*[10_000] * 19)
        held = take(camera, 16)
        assert camera.next_frame(0.05) is None
        held[3].release()
        assert take_numbers(camera, 1) == [16]
        assert [int(frame.pixels[0, 0]) for frame in held[4:]] == list(range(4, 16))

    def test_counters_can_be_read_while_another_thread_waits_for_an_image(self, world: GenTLWorld) -> None:
        camera = armed(world)
        with ThreadPoolExecutor(1) as waiting:
            coming = waiting.submit(take_numbers, camera, 1)
            assert [camera.statistics().exposed for _ in range(3)] == [0, 0, 0]
            world.fire()
            assert coming.result() == [0]

    def test_counters_stay_readable_after_the_end(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.fire(10_000, 1_000)
        camera.disarm()
        found = camera.statistics()
        assert (found.exposed, found.over_triggers) == (2, 1)

    def test_an_image_that_has_come_is_given_at_the_first_look(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.fire(*[10_000] * 39)
        _wait_until_sent(world, 40)
        found = []
        for _ in range(40):
            frame = camera.next_frame(0.0)
            if frame is not None:
                found.append(int(frame.pixels[0, 0]))
                frame.release()
        assert len(found) >= 38


class TestGone:
    """A camera that is pulled, whatever is being done with it."""

    def test_a_producer_that_says_nothing_of_it_does_not_hide_it(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.unplug(silently=True)
        with pytest.raises(DeviceLost, match="expected the camera to answer"):
            camera.next_frame(30.0)

    def test_short_waits_notice_it_too(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.unplug(silently=True)
        with pytest.raises(DeviceLost):
            _wait_shortly_and_often(camera)

    def test_images_that_came_before_are_given_first(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.fire(10_000)
        _wait_until_sent(world, 2)
        world.unplug()
        assert take_numbers(camera, 2) == [0, 1]
        with pytest.raises(DeviceLost):
            camera.next_frame(30.0)

    @pytest.mark.parametrize("call", ["self_test", "statistics", "disarm"])
    def test_every_call_that_needs_it_says_so(self, world: GenTLWorld, call: str) -> None:
        camera = armed(world)
        world.unplug()
        with pytest.raises(DeviceLost, match="the camera is gone"):
            getattr(camera, call)()

    def test_configuring_it_says_so(self, world: GenTLWorld) -> None:
        camera = world.open()
        world.unplug()
        with pytest.raises(DeviceLost, match="the camera is gone"):
            camera.configure(EXPOSURE)

    def test_harvesters_does_not_print_it_as_well(
        self, world: GenTLWorld, caplog: pytest.LogCaptureFixture
    ) -> None:
        printing = logging.getLogger("harvesters.core")
        printing.addHandler(caplog.handler)
        camera = armed(world)
        world.unplug()
        with pytest.raises(DeviceLost):
            camera.next_frame(30.0)
        printing.removeHandler(caplog.handler)
        assert printing.name not in {record.name for record in caplog.records}


class TestSetting:
    """What the camera is told, and what it may not be told."""

    def test_the_trigger_of_frames_is_set_and_the_automatic_exposure_is_off(self, world: GenTLWorld) -> None:
        world.open(trigger_line="Line1").configure(EXPOSURE)
        assert [world.register(at) for at in (TRIGGER_MODE, TRIGGER_SOURCE, EXPOSURE_AUTO)] == [1, 1, 0]

    def test_only_the_chosen_line_triggers(self, world: GenTLWorld) -> None:
        camera = armed(world, trigger_line="Line1")
        world.fire()
        assert camera.next_frame(0.05) is None

    def test_a_region_of_the_sensor_is_read_out(self, world: GenTLWorld) -> None:
        region = {"width_px": 20, "height_px": 10, "left_px": 4, "top_px": 6}
        camera = world.open(region=region)
        frame_format = camera.configure(EXPOSURE)
        camera.arm(8)
        world.fire()
        (frame,) = take(camera, 1)
        assert (frame_format.height_px, frame_format.width_px) == frame.pixels.shape == (10, 20)
        assert [world.register(at) for at in (OFFSET_X, OFFSET_Y)] == [4, 6]

    @pytest.mark.parametrize(
        ("pixel_format", "bits", "shown"), [("BayerGB12p", 12, 5), ("BayerGB16", 16, 80), ("BayerGB8", 8, 0)]
    )
    def test_other_formats_are_widened_to_16_bits(
        self, world: GenTLWorld, pixel_format: str, bits: int, shown: int
    ) -> None:
        camera = world.open(pixel_format=pixel_format)
        assert camera.configure(EXPOSURE).bit_depth == bits
        camera.arm(8)
        world.fire(*[10_000] * 5)
        assert take_numbers(camera, 6)[5] == shown

    def test_exposures_of_a_bracket_follow_each_other(self, world: GenTLWorld) -> None:
        camera = world.open()
        for step, exposure_us in enumerate((500, 2_000, 8_000)):
            camera.configure(Exposure(exposure_us))
            camera.arm(8)
            world.fire()
            assert take_numbers(camera, 1) == [step]
            camera.disarm()

    @pytest.mark.parametrize(
        ("exposure", "feature"), [(Exposure(5), "ExposureTime"), (Exposure(2_000, gain_db=30.0), "Gain")]
    )
    def test_a_value_out_of_the_cameras_range_is_refused_by_name(
        self, world: GenTLWorld, exposure: Exposure, feature: str
    ) -> None:
        with pytest.raises(DeviceRefused, match=f"for `{feature}`"):
            world.open().configure(exposure)

    def test_the_producers_least_number_of_buffers_is_kept(self, world: GenTLWorld) -> None:
        camera = armed(world, buffers=2)
        world.fire()
        assert take_numbers(camera, 1) == [0]

    @pytest.mark.parametrize("character", [{"tl_type": "GEV", "first_frame_id": 65534}])
    def test_ids_of_gige_vision_go_from_65535_to_1(self, world: GenTLWorld) -> None:
        camera = armed(world)
        world.fire(*[10_000] * 3)
        assert camera.id_modulus == (1, 65535)
        assert [frame.frame_id for frame in take(camera, 4)] == [65534, 65535, 1, 2]
        assert camera.statistics().lost_transfers == 0

    @pytest.mark.parametrize("character", [{"ticks_hz": 125_000_000}])
    def test_timestamps_in_ticks_become_nanoseconds(self, world: GenTLWorld) -> None:
        camera = armed(world)
        edges_ns = world.fire(11_000, 25_000)
        stamps_ns = [frame.timestamp_ns for frame in take(camera, 3)]
        assert np.diff(stamps_ns) == pytest.approx(np.diff(edges_ns), abs=2e3 * camera.timestamp_jitter_us)


class TestOpening:
    """Which camera, by whom, and what if it cannot be had."""

    def test_a_refused_second_client_does_not_disturb_the_first(self, world: GenTLWorld) -> None:
        camera = armed(world)
        with pytest.raises(DeviceRefused, match="in use"):
            world.open()
        world.fire()
        assert take_numbers(camera, 1) == [0]

    def test_a_camera_that_another_process_has_is_refused(self, world: GenTLWorld, producer: Path) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
            other.connect(str(producer.with_name(f"{SERIAL}.camera")))
            other.send(b"control")
            assert other.recv(1) == b"+"
            with pytest.raises(DeviceRefused, match="in use"):
                world.open()

    def test_a_camera_is_chosen_by_serial_number_and_model(self, world: GenTLWorld) -> None:
        assert world.open(serial=SERIAL, model="Stand-in").identify().serial == SERIAL

    def test_a_setting_that_is_refused_leaves_the_camera_free(self, world: GenTLWorld) -> None:
        with pytest.raises(DeviceRefused):
            world.open(features={"Gain": 99.0})
        assert world.open().identify().vendor == "Coupole"

    def test_a_file_that_is_no_producer_is_reported(self, world: GenTLWorld, tmp_path: Path) -> None:
        (tmp_path / "maker.cti").write_text("no library")
        with pytest.raises(DeviceLost, match=r"maker\.cti"):
            world.open(producer=tmp_path / "maker.cti")

    def test_ctrl_c_stays_with_the_program(self, world: GenTLWorld) -> None:
        before = signal.getsignal(signal.SIGINT)
        world.open()
        assert signal.getsignal(signal.SIGINT) is before


def _wait_shortly_and_often(camera: GenTLCamera) -> None:
    for _ in range(1000):
        camera.next_frame(0.02)


def _wait_until_sent(world: GenTLWorld, images: int) -> None:
    """Until the camera has sent so many and the producer has had time to take them off the cable."""
    end_s = time.monotonic() + PATIENCE_S
    while world.sent < images:
        assert time.monotonic() < end_s
        time.sleep(0.01)
    time.sleep(0.1)


class TestGaps:
    """What ids tell of images that did not come."""

    @settings(deadline=None)
    @given(st.lists(st.booleans(), min_size=1, max_size=200), st.integers(1, 65535))
    def test_every_image_lost_between_two_is_counted_whatever_the_ids_wrap(
        self, lost: list[bool], first: int
    ) -> None:
        gaps = Gaps()
        gaps.begin((1, 65535))
        arrivals = [True, *(not gone for gone in lost), True]
        for step, arrived in enumerate(arrivals):
            if arrived:
                gaps.whole((first - 1 + step) % 65535 + 1)
        assert gaps.delivered == sum(arrivals)
        assert gaps.missing == sum(lost)

    def test_an_incomplete_image_is_missing_once(self) -> None:
        gaps = Gaps()
        gaps.begin((1, 65535))
        gaps.whole(1)
        gaps.incomplete()
        gaps.whole(3)
        gaps.incomplete()
        assert (gaps.delivered, gaps.missing) == (2, 2)

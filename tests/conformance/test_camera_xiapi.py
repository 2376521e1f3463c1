"""What every Camera must do, run on the xiAPI driver over a stand-in for XIMEA's library; and what is its own."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from xiapi_world import XiWorld, compile_stub, needs_compiler

from coupole.devices import Exposure
from coupole.errors import DeviceLost, DeviceRefused
from coupole.testing.camera_conformance import EXPOSURE, HEIGHT_PX, WIDTH_PX, CameraConformance, take, take_numbers
from coupole.testing.camera_state_conformance import ForeignStateConformance, Left
from drivers.camera.xiapi.library import Image, code_name

pytestmark = needs_compiler
PERIOD_NS = 10_000_000


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compile_stub(tmp_path_factory.mktemp("xiapi"))


@pytest.fixture
def world(library: Path) -> Iterator[XiWorld]:
    world = XiWorld(library)
    yield world
    world.close()


class TestXiCamera(CameraConformance):
    """The contract, over xiAPI's functions."""


LEFT: Mapping[str, Left] = {
    "exposure 5 ms after the edge": (("trigger_delay", 5000),),
    "input is debounced": (("gpi_selector", 1), ("dbnc_en", 1)),
    "early edges are latched": (("trigger_overlap", 2),),
    "exposure lasts as long as the trigger": (("trigger_selector", 1),),
    "another input triggers too": (("gpi_selector", 2), ("gpi_mode", 1)),
    "frame rate is limited": (("acq_timing_mode", 2),),
    "several exposures in a frame": (("exposure_burst_count", 3),),
    "exposure is automatic": (("aeag", 1),),
    "gain by numbers": (("gain_selector", 2), ("gain", 6), ("gain_selector", 0)),
    "a part of the sensor": (("width", 16), ("height", 8), ("offsetX", 8), ("offsetY", 4)),
    "sampled down": (("downsampling", 2),),
    "columns are binned": (("binning_horizontal", 2),),
    "rows are binned": (("binning_vertical", 2),),
    "columns are skipped": (("decimation_horizontal", 2),),
    "rows are skipped": (("decimation_vertical", 2),),
    "mirrored left to right": (("horizontal_flip", 1),),
    "mirrored top to bottom": (("vertical_flip", 1),),
    "a test pattern of the sensor": (("test_pattern", 2),),
    "a test pattern of the FPGA": (("test_pattern_generator_selector", 1), ("test_pattern", 2)),
    "a look-up table": (("LUTEnable", 1),),
    "newest frame first": (("recent_frame", 1),),
    "12 bits are 8": (("output_bit_depth", 8),),
}


class TestForeignState(ForeignStateConformance):
    """After another program over xiAPI."""

    @pytest.fixture
    def world(self, library: Path) -> Iterator[ShowingWorld]:
        world = ShowingWorld(library)
        yield world
        world.close()

    @pytest.fixture(params=list(LEFT))
    def left(self, request: pytest.FixtureRequest) -> Left:
        return LEFT[request.param]

    @pytest.fixture
    def all_left(self) -> Mapping[str, Left]:
        return {what: left for what, left in LEFT.items() if not what.startswith(("columns", "rows"))}


NOT_SIMULATED = (
    "shutter_type",
    "concat_img_mode",
    "auto_wb",
    "bpc",
    "ffc",
    "hdr",
    "trans_data_black_level_ovr_en",
    "exposure_time_selector",
    "interline_exposure_mode",
)


@pytest.mark.parametrize(
    ("parameter", "left", "right"), [*((name, 1, 0) for name in NOT_SIMULATED), ("gammaY", 0, 1), ("gammaC", 0, 1)]
)
def test_what_the_stand_in_does_not_simulate_is_set_too(
    world: XiWorld, parameter: str, left: int, right: int
) -> None:
    world.leave(((parameter, left),))
    camera = world.open()
    assert world.parameter(parameter) == right
    assert camera.identify().settings[parameter] == str(right)


def test_a_parameter_that_the_rig_leaves_stays(world: XiWorld) -> None:
    world.leave((("bpc", 1),))
    world.open(leave=["bpc"])
    assert world.parameter("bpc") == 1


class ShowingWorld(XiWorld):
    """Frames show the ramp; 11 ms after each edge of the box something else sends one to input 2."""

    def __init__(self, library: Path) -> None:
        super().__init__(library)
        self.stub.stub_show_ramp()

    def edge(self, t_ns: int, trigger_input: int = 1) -> None:
        super().edge(t_ns, trigger_input)
        self.stub.stub_edge(2, t_ns + 11_000_000)


class TestLosses:
    """Whatever is lost leaves a gap in the ids or a count of missed edges."""

    def test_an_image_lost_on_its_way_is_counted_and_leaves_a_gap(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.fire()
        world.stub.stub_lose(2)
        world.fire(10_000, 10_000)
        ids = [frame.frame_id for frame in take(camera, 2)]
        found = camera.statistics()
        assert ids == [0, 3]
        assert (found.exposed, found.delivered, found.lost_transfers) == (4, 2, 2)

    def test_an_image_lost_in_the_cameras_memory_is_counted_and_leaves_a_gap(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.stub.stub_overflow(1)
        world.fire(10_000)
        (frame,) = take(camera, 1)
        assert frame.frame_id == 1
        assert camera.statistics().lost_transfers == 1

    def test_images_that_find_the_queue_full_are_counted_and_leave_a_gap(self, world: XiWorld) -> None:
        camera = world.open(buffers=2)
        camera.configure(EXPOSURE)
        camera.arm(4)
        for step in range(7):
            world.edge((step + 1) * PERIOD_NS)
        assert take_numbers(camera, 4) == [0, 1, 2, 3]
        world.edge(8 * PERIOD_NS)
        (frame,) = take(camera, 1)
        found = camera.statistics()
        assert frame.frame_id == 7
        assert (found.exposed, found.delivered, found.overflows) == (8, 5, 3)

    def test_an_edge_that_finds_the_cameras_memory_full_is_counted_and_leaves_no_gap(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.stub.stub_miss(1)
        world.fire(10_000, 10_000)
        assert [frame.frame_id for frame in take(camera, 2)] == [0, 1]
        assert camera.statistics().over_triggers == 1

    def test_images_wait_in_the_queue_while_all_buffers_are_in_hand(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(32)
        world.fire(*[10_000] * 19)
        held = take(camera, 16)
        assert camera.next_frame(0.05) is None
        held[3].release()
        assert take_numbers(camera, 1) == [16]
        assert [int(frame.pixels[0, 0]) for frame in held[4:]] == list(range(4, 16))

    def test_counters_can_be_read_while_another_thread_waits_for_an_image(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        with ThreadPoolExecutor(1) as waiting:
            coming = waiting.submit(take_numbers, camera, 1)
            assert [camera.statistics().exposed for _ in range(3)] == [0, 0, 0]
            world.fire()
            assert coming.result() == [0]

    def test_counters_stay_readable_after_the_end(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.fire(10_000, 1_000)
        camera.disarm()
        found = camera.statistics()
        assert (found.exposed, found.over_triggers) == (2, 1)


class TestSetting:
    """What the camera is told, and what it may not be told."""

    def test_the_camera_is_set_to_packed_12_bits_and_to_ignore_early_edges(self, world: XiWorld) -> None:
        world.open().configure(EXPOSURE)
        told = {name: world.parameter(name) for name in ("output_bit_depth", "output_bit_packing", "aeag")}
        assert told == {"output_bit_depth": 12, "output_bit_packing": 1, "aeag": 0}
        assert world.parameter("trigger_overlap") == 1
        assert world.parameter("recent_frame") == 0

    def test_the_queue_has_room_for_the_images_that_were_asked_for(self, world: XiWorld) -> None:
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(200)
        image_bytes = 2 * HEIGHT_PX * WIDTH_PX
        assert world.parameter("buffers_queue_size") == 200
        assert world.parameter("acq_buffer_size") * world.parameter("acq_buffer_size_unit") >= 200 * image_bytes

    def test_only_the_chosen_input_triggers(self, world: XiWorld) -> None:
        camera = world.open(trigger_input=2)
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.edge(PERIOD_NS, trigger_input=1)
        assert camera.next_frame(0.05) is None
        world.edge(2 * PERIOD_NS, trigger_input=2)
        assert take_numbers(camera, 1) == [0]

    @pytest.mark.parametrize(("inverted", "mode"), [(False, 6), (True, 7)])
    def test_the_ready_line_shows_when_the_camera_waits_for_an_edge(
        self, world: XiWorld, inverted: bool, mode: int
    ) -> None:
        world.open(ready_output=3, ready_inverted=inverted)
        assert (world.parameter("gpo_selector"), world.parameter("gpo_mode")) == (3, mode)

    def test_a_region_of_the_sensor_is_read_out(self, world: XiWorld) -> None:
        camera = world.open(region={"width_px": 20, "height_px": 10, "left_px": 4, "top_px": 6})
        frame_format = camera.configure(EXPOSURE)
        camera.arm(8)
        world.fire()
        (frame,) = take(camera, 1)
        assert (frame_format.height_px, frame_format.width_px) == frame.pixels.shape == (10, 20)
        assert (world.parameter("offsetX"), world.parameter("offsetY")) == (4, 6)

    def test_rows_that_are_padded_are_moved_together(self, world: XiWorld) -> None:
        world.stub.stub_pad(24)
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.fire(10_000, 10_000)
        for number, frame in enumerate(take(camera, 3)):
            assert frame.pixels.flags.c_contiguous
            assert np.array_equal(frame.pixels, np.full((HEIGHT_PX, WIDTH_PX), number))

    @pytest.mark.parametrize(
        ("exposure", "parameter"), [(Exposure(5), "exposure"), (Exposure(2_000, gain_db=30.0), "gain")]
    )
    def test_a_value_out_of_the_cameras_range_is_refused_by_name(
        self, world: XiWorld, exposure: Exposure, parameter: str
    ) -> None:
        with pytest.raises(DeviceRefused, match=f"camera: expected `{parameter}` from"):
            world.open().configure(exposure)

    def test_an_unknown_parameter_of_the_rig_is_refused_with_xiapis_own_word(self, world: XiWorld) -> None:
        with pytest.raises(DeviceRefused, match=r"`warp_factor` to take 9; .*XI_UNKNOWN_PARAM \(100\)"):
            world.open(parameters={"warp_factor": 9})

    def test_an_image_with_another_black_level_than_the_cameras_is_refused(self, world: XiWorld) -> None:
        world.stub.stub_shift_black(3)
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.fire()
        with pytest.raises(DeviceRefused, match="67 DN"):
            camera.next_frame(1.0)

    def test_timestamps_that_are_no_seconds_are_refused(self, world: XiWorld) -> None:
        world.stub.stub_use_ticks()
        camera = world.open()
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.edge(3_600_000_000_000)
        with pytest.raises(DeviceRefused, match="`timestamps`"):
            camera.next_frame(1.0)

    def test_timestamps_may_be_counts_of_4_ns(self, world: XiWorld) -> None:
        world.stub.stub_use_ticks()
        camera = world.open(timestamps="4ns")
        camera.configure(EXPOSURE)
        camera.arm(8)
        world.edge(3_600_000_000_000)
        (frame,) = take(camera, 1)
        assert frame.timestamp_ns == 3_600_000_000_000

    def test_the_rig_may_say_what_is_black(self, world: XiWorld) -> None:
        world.stub.stub_shift_black(3)
        camera = world.open(black_dn=67)
        assert camera.configure(EXPOSURE).black_dn == 67
        camera.arm(8)
        world.fire()
        assert take_numbers(camera, 1) == [0]


class TestOpening:
    """Which camera, and what if it is not there."""

    def test_of_several_cameras_one_must_be_named(self, world: XiWorld) -> None:
        world.stub.stub_reset(2)
        with pytest.raises(DeviceLost, match="2 are connected"):
            world.open()
        assert world.open(serial="00000120").identify().serial == "00000120"

    def test_a_missing_library_is_reported_with_what_to_install(self, world: XiWorld) -> None:
        with pytest.raises(DeviceLost, match="Install XIMEA's software package"):
            world.open(library="libm3api-that-is-not-there.so.2")

    def test_a_setting_that_is_refused_leaves_the_camera_free(self, world: XiWorld) -> None:
        with pytest.raises(DeviceRefused):
            world.open(parameters={"gain": 99.0})
        assert world.open().identify().vendor == "XIMEA"

    def test_a_camera_that_is_gone_fails_its_self_test(self, world: XiWorld) -> None:
        camera = world.open()
        world.unplug()
        with pytest.raises(DeviceLost, match="gone"):
            camera.self_test()

    def test_the_image_is_laid_out_as_the_c_compiler_does_it(self, world: XiWorld) -> None:
        layout = [world.stub.stub_image_layout(field) for field in range(4)]
        of_python = [Image.acq_nframe.offset, Image.data_saturation.offset, Image.color_filter_array.offset]
        assert layout == [ctypes.sizeof(Image), *of_python]

    def test_codes_have_xiapis_names(self) -> None:
        assert [code_name(code) for code in (38, 57, 61, 106, 120, 205)] == [
            "XI_INVALID_DATA",
            "XI_RESOURCE_OR_FUNCTION_LOCKED",
            "XI_RESOURCE_NOT_FOUND",
            "XI_NOT_SUPPORTED_PARAM",
            "XI_ERR_FRAME_BUFFER_RAM_INIT",
            "XI_OUT_OF_RANGE",
        ]

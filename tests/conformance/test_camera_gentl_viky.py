"""The GenTL driver on the producer that the package genicam ships: one that we did not write.

It bounces a ball at its own pace, without trigger, exposure time and timestamps, so that of `CameraConformance`
nothing can be run on it; what does not need a trigger is asked here in its words.
"""

from __future__ import annotations

import mmap
import signal
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Protocol

import genicam
import numpy as np
import pytest

from coupole.clock import SystemClock
from coupole.errors import DeviceLost, DeviceRefused
from coupole.testing.camera_conformance import A_MOMENT_S, BY_SOFTWARE, EXPOSURE, take
from drivers.camera.gentl.driver import GenTLCamera
from drivers.camera.gentl.settings import Settings

PRODUCER = Path(genicam.__file__).with_name("viky.cti")
SIZE_PX = 400
VIKY = {
    "producer": PRODUCER,
    "serial": "1",
    "pixel_format": "Mono8",
    "free_running": True,
    "timestamps": "host",
    "features": {"AcquisitionFrameRate": 100.0},
    "region": {"width_px": SIZE_PX, "height_px": SIZE_PX},
}


class Open(Protocol):
    def __call__(self, **settings: Any) -> GenTLCamera: ...


@pytest.fixture
def open_camera() -> Iterator[Open]:
    with ExitStack() as opened:

        def opener(**settings: Any) -> GenTLCamera:
            camera = GenTLCamera(Settings.model_validate({**VIKY, **settings}), SystemClock())
            return opened.enter_context(closing(camera))

        yield opener


@pytest.fixture
def camera(open_camera: Open) -> GenTLCamera:
    camera = open_camera()
    camera.configure(EXPOSURE)
    return camera


class TestContract:
    """What of `coupole.devices.Camera` needs no trigger."""

    def test_it_says_who_it_is(self, camera: GenTLCamera) -> None:
        identity = camera.identify()
        assert (identity.model, identity.serial) == ("Viky", "1")
        assert camera.self_test()["PixelFormat"] == "Mono8"

    def test_configure_says_what_frames_look_like(self, camera: GenTLCamera) -> None:
        frame_format = camera.configure(EXPOSURE)
        assert (frame_format.height_px, frame_format.width_px) == (SIZE_PX, SIZE_PX)
        assert (frame_format.bayer_pattern, frame_format.bit_depth, frame_format.white_dn) == ("MONO", 8, 255)

    def test_pixels_begin_on_a_page_and_are_contiguous(self, camera: GenTLCamera) -> None:
        camera.arm(8)
        for frame in take(camera, 3):
            assert frame.pixels.ctypes.data % mmap.PAGESIZE == 0
            assert frame.pixels.flags.c_contiguous
            assert (frame.pixels.dtype, frame.pixels.shape) == (np.uint16, (SIZE_PX, SIZE_PX))

    def test_frames_show_a_picture_of_8_bits(self, camera: GenTLCamera) -> None:
        camera.arm(8)
        (frame,) = take(camera, 1)
        assert frame.pixels.min() < frame.pixels.max() <= 255

    def test_a_frame_keeps_its_pixels_until_it_is_released(self, camera: GenTLCamera) -> None:
        camera.arm(8)
        (kept,) = take(camera, 1)
        before = kept.pixels.copy()
        for _ in range(20):
            take(camera, 1)[0].release()
        assert np.array_equal(kept.pixels, before)

    def test_ids_and_statistics_agree_on_what_is_missing(self, camera: GenTLCamera) -> None:
        camera.arm(8)
        ids = []
        for _ in range(30):
            (frame,) = take(camera, 1)
            ids.append(frame.frame_id)
            frame.release()
        found = camera.statistics()
        gaps = int((np.diff(ids) - 1).sum())
        assert min(np.diff(ids)) >= 1
        assert found.delivered == 30
        assert found.lost_transfers + found.overflows == gaps
        assert (found.exposed, found.over_triggers) == (-1, -1)

    def test_frames_that_nobody_takes_are_missed_and_told(self, open_camera: Open) -> None:
        camera = open_camera(buffers=2)
        camera.configure(EXPOSURE)
        camera.arm(2)
        held = take(camera, 2)
        assert camera.next_frame(A_MOMENT_S) is None
        for frame in held:
            frame.release()
        ids = [frame.frame_id for frame in held]
        for _ in range(10):
            (frame,) = take(camera, 1)
            ids.append(frame.frame_id)
            frame.release()
        found = camera.statistics()
        assert found.lost_transfers + found.overflows == int((np.diff(ids) - 1).sum()) > 0

    def test_arming_anew_forgets_frames_and_counters_of_before(self, camera: GenTLCamera) -> None:
        camera.arm(8)
        take(camera, 3)
        camera.disarm()
        camera.arm(8)
        assert camera.statistics().delivered == 0
        assert len(take(camera, 1)) == 1

    def test_a_disarmed_camera_gives_no_frames(self, camera: GenTLCamera) -> None:
        camera.arm(8)
        take(camera, 1)
        camera.disarm()
        camera.disarm()
        assert camera.next_frame(A_MOMENT_S) is None

    def test_arming_before_configuring_is_refused(self, open_camera: Open) -> None:
        with pytest.raises(DeviceRefused, match="configure"):
            open_camera().arm(8)

    def test_closing_lets_the_next_client_in(self, open_camera: Open) -> None:
        first = open_camera()
        first.configure(EXPOSURE)
        first.arm(8)
        first.close()
        second = open_camera()
        second.configure(EXPOSURE)
        second.arm(8)
        assert len(take(second, 1)) == 1

    def test_the_least_period_is_the_shortest_that_the_camera_names(self, camera: GenTLCamera) -> None:
        assert camera.min_period_us(EXPOSURE) == 5_000


class TestSetting:
    """What is refused, and in which words."""

    def test_a_camera_without_trigger_is_refused_unless_it_may_run_freely(self, open_camera: Open) -> None:
        with pytest.raises(DeviceRefused, match="TriggerMode"):
            open_camera(free_running=False).configure(EXPOSURE)

    def test_a_camera_that_runs_freely_takes_no_software_trigger(self, open_camera: Open) -> None:
        camera = open_camera()
        camera.configure(BY_SOFTWARE)
        camera.arm(2)
        with pytest.raises(DeviceRefused, match="software trigger"):
            camera.trigger()

    def test_frames_without_timestamps_are_refused_unless_the_host_may_stamp_them(self, open_camera: Open) -> None:
        camera = open_camera(timestamps="camera")
        camera.configure(EXPOSURE)
        camera.arm(2)
        with pytest.raises(DeviceRefused, match="timestamps: host"):
            camera.next_frame(5.0)

    @pytest.mark.parametrize(
        ("features", "message"),
        [
            ({"AcquisitionFrameRate": 500.0}, "1 to 200 for `AcquisitionFrameRate`; 500 was given"),
            ({"AcquisitionFrameRate": "fast"}, "a float for `AcquisitionFrameRate`"),
            ({"BouncingBallSize": True}, "a integer for `BouncingBallSize`; True was given"),
            ({"PixelFormat": "Mono9"}, "one of RGBa8, Mono8 for `PixelFormat`"),
            ({"Warp": 9}, "a camera with the feature `Warp`"),
            ({"PayloadSize": 5}, "`PayloadSize`"),
        ],
    )
    def test_a_feature_that_the_camera_cannot_take_is_refused_by_name(
        self, open_camera: Open, features: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(DeviceRefused, match=message):
            open_camera(features=features)

    def test_a_pixel_format_that_is_no_raw_picture_is_refused(self, open_camera: Open) -> None:
        with pytest.raises(DeviceRefused, match="it sends RGBa8"):
            open_camera(pixel_format="RGBa8").configure(EXPOSURE)

    def test_of_several_cameras_one_must_be_named(self, open_camera: Open) -> None:
        with pytest.raises(DeviceLost, match="3 of the producer's fit"):
            open_camera(serial="")

    def test_a_missing_producer_is_reported(self, open_camera: Open, tmp_path: Path) -> None:
        with pytest.raises(DeviceLost, match="no such file"):
            open_camera(producer=tmp_path / "maker.cti")

    def test_a_second_client_in_this_process_is_refused(self, open_camera: Open) -> None:
        open_camera()
        with pytest.raises(DeviceRefused, match="in use"):
            open_camera()

    def test_ctrl_c_stays_with_the_program(self, open_camera: Open) -> None:
        before = signal.getsignal(signal.SIGINT)
        open_camera()
        assert signal.getsignal(signal.SIGINT) is before

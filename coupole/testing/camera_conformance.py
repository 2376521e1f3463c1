"""The contract of cameras as one class, which tests each driver against a simulated camera at the other end of its
wire."""

from __future__ import annotations

import mmap
import threading
from collections.abc import Callable
from typing import ClassVar, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.devices import Camera, Exposure, Frame, FrameFormat
from coupole.errors import DeviceError, DeviceLost, DeviceRefused

HEIGHT_PX, WIDTH_PX, WHITE_DN = 24, 40, 4095
EXPOSURE = Exposure(exposure_us=2_000)
BY_SOFTWARE = Exposure(exposure_us=2_000, hardware_trigger=False)
PATIENCE_S = 10.0
A_MOMENT_S = 0.2
"""Time for which a test waits to see that no frame comes, s."""


class CameraWorld(Protocol):
    """A camera, its trigger cable and its clock; every pixel of a frame shows the number of its exposure."""

    def open(self) -> Camera:
        """Open a driver of the camera; it is closed with the world."""
        ...

    def open_nothing(self) -> Camera:
        """Open a camera that does not exist."""
        ...

    def fire(self, *periods_us: int) -> list[int]:
        """Send one trigger edge, and one more after each of `periods_us`; return the times of all edges, ns of the
        world."""
        ...

    def unplug(self) -> None:
        """Pull the camera's cable."""
        ...

    @property
    def is_armed(self) -> bool:
        """True if trigger edges make the camera expose frames."""
        ...


def expected_ramp(number: int) -> NDArray[np.uint16]:
    """Return frame number `number` of a ramp [HEIGHT_PX, WIDTH_PX]: it grows by 1000 for each frame, 40 for each
    row and 1 for each column."""
    return (1000 * number + np.arange(HEIGHT_PX * WIDTH_PX).reshape(HEIGHT_PX, WIDTH_PX)).astype(np.uint16)


def take(camera: Camera, count: int) -> list[Frame]:
    """Return `count` frames, which are not released."""
    frames = [camera.next_frame(PATIENCE_S) for _ in range(count)]
    assert None not in frames
    return [frame for frame in frames if frame is not None]


def take_numbers(camera: Camera, count: int) -> list[int]:
    """Return the numbers that `count` frames show; each frame is released at once."""
    numbers = []
    for _ in range(count):
        (frame,) = take(camera, 1)
        assert (frame.pixels == frame.pixels[0, 0]).all()
        numbers.append(int(frame.pixels[0, 0]))
        frame.release()
    return numbers


def _while_taking(camera: Camera, count: int, act: Callable[[], object]) -> list[int]:
    """Return the numbers that `count` frames show. A thread takes and releases the frames while `act` causes
    them."""
    numbers: list[int] = []
    taker = threading.Thread(target=lambda: numbers.extend(take_numbers(camera, count)))
    taker.start()
    act()
    taker.join()
    return numbers


class CameraConformance:
    """The contract `coupole.devices.Camera`.

    A subclass gives the fixture `world`, a `CameraWorld`: the camera that the driver talks to, with small frames.
    Refusals tell people what to do. If a camera was not configured, the refusal names `configure`. If another
    program has the camera, it says `in use`.
    """

    frame_format: ClassVar[FrameFormat] = FrameFormat(HEIGHT_PX, WIDTH_PX, 12, "GBRG", 64, WHITE_DN)
    """Format of frames that `configure` must return."""
    readout_us: ClassVar[int] = 10_000
    """Least time between frames by the sensor's readout; longer than 4 ms."""
    exposure_gap_us: ClassVar[int] = 100
    """Least time from the end of one exposure to the start of the next."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frames, px."""
        return self.frame_format.height_px, self.frame_format.width_px

    @pytest.fixture
    def camera(self, world: CameraWorld) -> Camera:
        """A camera that is opened and configured for trigger edges, but not armed."""
        camera = world.open()
        camera.configure(EXPOSURE)
        return camera

    def test_it_says_who_it_is(self, camera: Camera) -> None:
        identity = camera.identify()
        assert all((identity.vendor, identity.model, identity.serial, identity.firmware))
        assert camera.self_test()

    def test_configure_says_what_frames_look_like(self, camera: Camera) -> None:
        assert camera.configure(EXPOSURE) == self.frame_format

    def test_the_least_period_covers_exposure_gap_and_readout(self, camera: Camera) -> None:
        assert camera.min_period_us(EXPOSURE) == self.readout_us
        long_us = 3 * self.readout_us
        assert camera.min_period_us(Exposure(long_us)) == long_us + self.exposure_gap_us

    def test_each_edge_makes_a_frame_in_order(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.fire(*[camera.min_period_us(EXPOSURE)] * 5)
        assert take_numbers(camera, 6) == list(range(6))

    def test_frame_ids_count_on_by_one(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.fire(*[self.readout_us + 2_000] * 3)
        ids = [frame.frame_id for frame in take(camera, 4)]
        assert ids == list(range(ids[0], ids[0] + 4))

    def test_timestamps_follow_the_edges(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        edges_ns = world.fire(*(self.readout_us + later_us for later_us in (1_000, 15_000, 3_000)))
        stamps_ns = [frame.timestamp_ns for frame in take(camera, 4)]
        allowed_ns = 2e3 * camera.timestamp_jitter_us + 1e-4 * (edges_ns[-1] - edges_ns[0])
        assert np.diff(stamps_ns) == pytest.approx(np.diff(edges_ns), abs=allowed_ns)

    def test_edges_at_the_least_period_are_all_taken(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(24)
        world.fire(*[camera.min_period_us(EXPOSURE)] * 19)
        assert take_numbers(camera, 20) == list(range(20))
        assert camera.statistics().over_triggers == 0

    def test_an_edge_that_comes_too_early_is_counted_and_makes_no_frame(
        self, camera: Camera, world: CameraWorld
    ) -> None:
        camera.arm(8)
        world.fire(3_000, self.readout_us + 2_000)
        assert len(take(camera, 2)) == 2
        assert camera.next_frame(A_MOMENT_S) is None
        statistics = camera.statistics()
        assert (statistics.exposed, statistics.over_triggers) == (2, 1)

    def test_next_frame_gives_none_when_nothing_comes_in_time(self, camera: Camera) -> None:
        camera.arm(8)
        assert camera.next_frame(0.01) is None

    def test_released_buffers_are_used_again(self, camera: Camera, world: CameraWorld) -> None:
        """There are many more frames than buffers; each frame is released before the next is taken."""
        camera.arm(8)
        numbers = _while_taking(camera, 150, lambda: world.fire(*[self.readout_us] * 149))
        assert numbers == list(range(150))
        statistics = camera.statistics()
        assert (statistics.overflows, statistics.lost_transfers) == (0, 0)

    def test_a_frame_keeps_its_pixels_until_it_is_released(self, camera: Camera, world: CameraWorld) -> None:
        """While one frame is kept, many more frames come than there are buffers."""
        camera.arm(8)
        world.fire()
        (kept,) = take(camera, 1)
        numbers = _while_taking(camera, 60, lambda: world.fire(*[self.readout_us] * 59))
        assert numbers == list(range(1, 61))
        assert (kept.pixels == 0).all()

    def test_pixels_begin_on_a_page_and_are_contiguous(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.fire(self.readout_us, self.readout_us)
        for frame in take(camera, 3):
            assert frame.pixels.ctypes.data % mmap.PAGESIZE == 0
            assert frame.pixels.flags.c_contiguous
            assert frame.pixels.dtype == np.uint16
            assert frame.pixels.shape == self.shape

    def test_statistics_add_up(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.fire(self.readout_us, 1_000, self.readout_us, self.readout_us)
        take(camera, 4)
        found = camera.statistics()
        assert (found.exposed, found.over_triggers) == (4, 1)
        assert found.exposed == found.delivered + found.lost_transfers + found.overflows

    def test_a_disarmed_camera_ignores_edges(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.fire()
        take_numbers(camera, 1)
        camera.disarm()
        world.fire(self.readout_us)
        assert not world.is_armed
        assert camera.next_frame(A_MOMENT_S) is None

    def test_disarming_twice_does_no_harm(self, camera: Camera) -> None:
        camera.arm(8)
        camera.disarm()
        camera.disarm()

    def test_arming_anew_forgets_frames_and_counters_of_before(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.fire(self.readout_us, self.readout_us)
        taken = take_numbers(camera, 1)
        camera.disarm()
        camera.arm(8)
        assert camera.statistics().exposed == 0
        world.fire()
        after = take_numbers(camera, 1)
        assert taken == [0]
        assert after[0] >= 2
        assert camera.statistics().exposed == 1

    def test_a_frame_released_after_its_session_does_not_disturb_the_next(
        self, camera: Camera, world: CameraWorld
    ) -> None:
        camera.arm(8)
        world.fire()
        (late,) = take(camera, 1)
        camera.disarm()
        camera.arm(8)
        late.release()
        world.fire()
        (kept,) = take(camera, 1)
        numbers = _while_taking(camera, 60, lambda: world.fire(*[self.readout_us] * 59))
        assert numbers == list(range(2, 62))
        assert (kept.pixels == 1).all()

    def test_a_software_trigger_makes_one_frame(self, world: CameraWorld) -> None:
        camera = world.open()
        camera.configure(BY_SOFTWARE)
        camera.arm(8)
        camera.trigger()
        assert take_numbers(camera, 1) == [0]
        assert camera.next_frame(A_MOMENT_S) is None

    def test_edges_make_no_frame_while_the_software_triggers(self, world: CameraWorld) -> None:
        camera = world.open()
        camera.configure(BY_SOFTWARE)
        camera.arm(8)
        world.fire()
        assert camera.next_frame(A_MOMENT_S) is None

    def test_a_software_trigger_is_refused_while_edges_trigger(self, camera: Camera) -> None:
        camera.arm(8)
        with pytest.raises(DeviceRefused, match="expected"):
            camera.trigger()

    def test_arming_before_configuring_is_refused(self, world: CameraWorld) -> None:
        with pytest.raises(DeviceRefused, match="configure"):
            world.open().arm(8)

    def test_a_second_client_is_refused(self, camera: Camera, world: CameraWorld) -> None:
        with pytest.raises(DeviceRefused, match="in use"):
            world.open()

    def test_closing_disarms_and_lets_the_next_client_in(self, world: CameraWorld) -> None:
        first = world.open()
        first.configure(EXPOSURE)
        first.arm(8)
        first.close()
        second = _when_free(world.open)
        _wait_until(lambda: not world.is_armed)
        second.configure(EXPOSURE)
        second.arm(8)
        world.fire()
        assert len(take(second, 1)) == 1

    def test_a_camera_that_is_not_there_is_reported(self, world: CameraWorld) -> None:
        with pytest.raises(DeviceError, match="expected"):
            world.open_nothing()

    def test_a_camera_whose_cable_is_pulled_is_reported(self, camera: Camera, world: CameraWorld) -> None:
        camera.arm(8)
        world.unplug()
        with pytest.raises(DeviceLost, match="expected"):
            camera.next_frame(30.0)


def _when_free(open_camera: Callable[[], Camera]) -> Camera:
    """Open the camera as soon as the world has noticed that the last client left."""
    for _ in range(100):
        try:
            return open_camera()
        except DeviceRefused:
            threading.Event().wait(0.02)
    return open_camera()


def _wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(500):
        if condition():
            return
        threading.Event().wait(0.02)
    assert condition()

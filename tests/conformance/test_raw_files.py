"""The still camera whose files come into a folder. The test is tethering program and camera at once.

The contract's class cannot be run on it: it cannot be told an exposure, a size or a trigger, and its period is
seconds. What the contract asks of frames, ids, times and statistics is asked here.
"""

from __future__ import annotations

import mmap
import os
import sys
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from places import SHARED_DATA
from tiny_dng import BLACK_DN, WHITE_DN, write_dng

from coupole.acquisition.frame_matching import FaultModel, match
from coupole.clock import SystemClock
from coupole.devices import STEP_RECORD_DTYPE, Exposure, Frame, FrameFormat
from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused
from coupole.plan.bursts import DeviceTimes
from coupole.plan.led_table import LedTable
from coupole.plan.plan import Plan
from coupole.plan.schedule import build_schedule
from drivers.camera.raw.driver import RawFiles, Settings
from drivers.camera.raw.picture import decode

REAL_DNG = SHARED_DATA / "raw/colorchart.dng"
HEIGHT_PX, WIDTH_PX = 24, 40
EXPOSURE = Exposure(8_000)
BY_COMMAND = Exposure(8_000, hardware_trigger=False)
STILL_S, PATIENCE_S = 0.1, 0.4
WAIT_S = 10.0
NOON = datetime(2026, 3, 4, 12, tzinfo=UTC)


class StillCamera:
    """Takes pictures every two seconds of its own clock; each is filled with its number."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.shots = folder, 0
        folder.mkdir()

    def picture(self, number: int, *, name: str | None = None, after_s: float | None = None, **tags: Any) -> Path:
        self.shots += 1
        taken = NOON + timedelta(seconds=2 * self.shots if after_s is None else after_s)
        pixels = np.full((HEIGHT_PX, WIDTH_PX), number, np.uint16)
        path = self.folder / (name or f"IMG_{number:04}.DNG")
        arriving = path.with_suffix(".part")
        given = {"taken": f"{taken:%Y:%m:%d %H:%M:%S}", "subseconds": f"{taken.microsecond // 10_000:02}", **tags}
        write_dng(arriving, pixels, **given)
        arriving.rename(path)
        os.utime(path, ns=(path.stat().st_atime_ns, 10**18 + self.shots))  # files of one tick stay in order
        return path


@pytest.fixture
def still(tmp_path: Path) -> StillCamera:
    """Has taken picture 41 already."""
    still = StillCamera(tmp_path / "tethered")
    still.picture(41)
    return still


def opened(still: StillCamera, **changed: Any) -> RawFiles:
    given = {"still_s": STILL_S, "patience_s": PATIENCE_S, **changed}
    return RawFiles(Settings(folder=still.folder, period_us=2_000_000, **given), SystemClock())


@pytest.fixture
def camera(still: StillCamera) -> RawFiles:
    """Waits for pictures."""
    camera = opened(still)
    camera.configure(EXPOSURE)
    camera.arm(16)
    return camera


def take(camera: RawFiles, count: int) -> list[Frame]:
    frames = [camera.next_frame(WAIT_S) for _ in range(count)]
    assert None not in frames
    return [frame for frame in frames if frame is not None]


def _log_of_a_burst(period_us: int) -> NDArray[np.void]:
    """What the box says of a burst of 40 lights at that period, marks at both ends."""
    index = np.arange(40)
    leds = LedTable(index, index // 6, np.full((40, 3), 1e3), np.full((40, 3), -1 / 3**0.5), np.ones(40))
    view = {"kind": "joints", "name": "v", "joints_deg": [0, -90, 90, 0, 90, 0]}
    exposure = {"kind": "fixed", "exposure_us": 8_000}
    plan = Plan.model_validate(
        {
            "schema_version": 1,
            "name": "p",
            "rig": "r",
            "views": [view],
            "lights": {"kind": "all"},
            "exposure": exposure,
        }
    )
    times = DeviceTimes(rise_us=1000, readout_us=float(period_us), exposure_gap_us=0)
    table = build_schedule(plan, leds, np.eye(4), times).bursts[0][0].table
    log = np.zeros(len(table), STEP_RECORD_DTYPE)
    log["step"], log["edge_sent"] = np.arange(len(table)), True
    log["t_trigger_ns"] = 10**9 + 1000 * np.cumsum([0, *table["period_us"][:-1].astype(np.int64)])
    log["t_on_ns"] = log["t_trigger_ns"] - 10**6
    return log


class TestFrames:
    """Files become frames."""

    def test_it_says_who_it_is(self, camera: RawFiles) -> None:
        identity = camera.identify()
        assert (identity.vendor, identity.model, identity.serial) == ("Acme", "Still", "4711")
        assert camera.self_test()["timestamp_resolution_us"] == "10000"

    def test_a_picture_taken_before_tells_what_frames_look_like(self, still: StillCamera) -> None:
        found = opened(still).configure(EXPOSURE)
        assert found == FrameFormat(HEIGHT_PX, WIDTH_PX, 14, "RGGB", BLACK_DN, WHITE_DN)

    def test_frames_come_in_order_with_number_time_and_pixels(self, still: StillCamera, camera: RawFiles) -> None:
        for number in (42, 43, 44):
            still.picture(number)
        frames = take(camera, 3)
        assert [frame.frame_id for frame in frames] == [42, 43, 44]
        assert [b.timestamp_ns - a.timestamp_ns for a, b in pairwise(frames)] == [2 * 10**9] * 2
        assert [int(frame.pixels[3, 5]) for frame in frames] == [42, 43, 44]
        assert (camera.statistics().exposed, camera.statistics().delivered) == (3, 3)

    def test_pixels_begin_on_a_page_and_are_contiguous(self, still: StillCamera, camera: RawFiles) -> None:
        still.picture(42)
        (frame,) = take(camera, 1)
        assert frame.pixels.ctypes.data % mmap.PAGESIZE == 0
        assert frame.pixels.flags.c_contiguous
        assert (frame.pixels.dtype, frame.pixels.shape) == (np.uint16, (HEIGHT_PX, WIDTH_PX))

    def test_a_frame_keeps_its_pixels_until_it_is_released(self, still: StillCamera, camera: RawFiles) -> None:
        for number in range(42, 50):
            still.picture(number)
        (kept,) = take(camera, 1)
        for _ in range(7):
            take(camera, 1)[0].release()
        assert (kept.pixels == 42).all()

    def test_the_number_after_9999_is_1(self, still: StillCamera) -> None:
        still.picture(9998)
        camera = opened(still)
        camera.configure(EXPOSURE)
        camera.arm(2)
        for number in (9999, 1, 2):
            still.picture(number)
        assert [frame.frame_id for frame in take(camera, 3)] == [9999, 1, 2]
        assert camera.id_modulus == (1, 9999)
        assert camera.statistics().lost_transfers == 0

    def test_pictures_of_before_and_other_files_are_left_alone(self, still: StillCamera, camera: RawFiles) -> None:
        (still.folder / "IMG_0042.JPG").write_bytes(b"not wanted")
        assert camera.next_frame(3 * STILL_S) is None

    def test_a_file_is_not_taken_while_it_grows(self, still: StillCamera) -> None:
        camera = opened(still, still_s=20 * STILL_S)  # longer than a busy machine pauses between two parts
        camera.configure(EXPOSURE)
        camera.arm(16)
        whole = still.picture(42).read_bytes()
        path = still.folder / "IMG_0042.DNG"
        for share in (4, 3, 2):
            path.write_bytes(whole[: len(whole) // share])
            assert camera.next_frame(STILL_S / 2) is None
        path.write_bytes(whole)
        (frame,) = take(camera, 1)
        assert (frame.pixels == 42).all()

    def test_the_first_numbers_may_arrive_in_any_order(self, still: StillCamera, tmp_path: Path) -> None:
        sample = still.picture(41).rename(tmp_path / "sample.dng")
        camera = opened(still, sample=sample)
        camera.configure(EXPOSURE)
        camera.arm(2)
        still.picture(2, after_s=20.0)
        still.picture(9999, after_s=16.0)
        still.picture(1, after_s=18.0)
        assert [frame.frame_id for frame in take(camera, 3)] == [9999, 1, 2]

    def test_disarmed_it_gives_no_frames(self, still: StillCamera, camera: RawFiles) -> None:
        camera.disarm()
        still.picture(42)
        assert camera.next_frame(3 * STILL_S) is None

    def test_arming_anew_forgets_what_was_not_taken(self, still: StillCamera, camera: RawFiles) -> None:
        still.picture(42)
        still.picture(43)
        take(camera, 1)
        camera.arm(2)
        still.picture(44)
        (frame,) = take(camera, 1)
        assert frame.frame_id == 44
        assert camera.statistics().exposed == 1


class TestProof:
    """What is missing, surplus or out of order is told or ends the run."""

    def test_a_picture_that_never_comes_leaves_a_gap(self, still: StillCamera, camera: RawFiles) -> None:
        still.picture(42)
        still.shots += 1
        still.picture(44)
        assert [frame.frame_id for frame in take(camera, 2)] == [42, 44]
        found = camera.statistics()
        assert (found.exposed, found.delivered, found.lost_transfers) == (3, 2, 1)

    def test_a_late_file_is_waited_for(self, still: StillCamera, camera: RawFiles) -> None:
        still.picture(43, after_s=100.0)
        assert camera.next_frame(PATIENCE_S / 2) is None
        still.picture(42, after_s=98.0)
        assert [frame.frame_id for frame in take(camera, 2)] == [42, 43]

    def test_a_file_that_comes_after_its_successor_was_taken_ends_the_run(
        self, still: StillCamera, camera: RawFiles
    ) -> None:
        still.picture(43)
        take(camera, 1)
        still.picture(42)
        with pytest.raises(DeviceFault, match=r"IMG_0042.DNG came after it"):
            camera.next_frame(WAIT_S)

    def test_two_files_of_one_number_end_the_run(self, still: StillCamera, camera: RawFiles) -> None:
        still.picture(42)
        still.picture(42, name="DSC_0042.NEF")
        with pytest.raises(DeviceFault, match="one file for each number"):
            camera.next_frame(WAIT_S)

    @pytest.mark.parametrize(
        ("tags", "message"),
        [
            ({"after_s": 1.0}, "not later"),
            ({"model": "Other"}, "a picture of Still 4711"),
            ({"iso": 800}, "ISO 100 as before in IMG_0043.DNG; it was ISO 800"),
            ({"exposure": (1, 60)}, "an exposure of 8000 us in IMG_0043.DNG; it was 16667 us"),
            ({"subseconds": ""}, "a capture time to 10000 us"),
            ({"taken": ""}, "no capture time"),
            ({"name": "sunset.DNG"}, "a name that ends in a number"),
        ],
    )
    def test_a_picture_that_is_not_of_the_burst_ends_the_run(
        self, still: StillCamera, camera: RawFiles, tags: dict[str, Any], message: str
    ) -> None:
        still.picture(42)
        take(camera, 1)
        still.picture(43, **tags)
        with pytest.raises(DeviceError, match=message):
            camera.next_frame(WAIT_S)

    def test_a_file_that_was_cut_off_ends_the_run(self, still: StillCamera, camera: RawFiles) -> None:
        path = still.picture(42)
        path.write_bytes(path.read_bytes()[:300])
        with pytest.raises(DeviceRefused, match="increase `still_s`"):
            camera.next_frame(WAIT_S)

    def test_a_folder_that_goes_away_is_reported(self, still: StillCamera, camera: RawFiles) -> None:
        still.folder.rename(still.folder.with_name("gone"))
        with pytest.raises(DeviceLost, match="network drive"):
            camera.next_frame(WAIT_S)

    @settings(deadline=None, max_examples=20)
    @given(lost=st.sets(st.integers(1, 18)), first=st.integers(1, 9999))
    def test_whatever_is_lost_between_two_files_shows_in_the_ids(
        self, tmp_path_factory: pytest.TempPathFactory, lost: set[int], first: int
    ) -> None:
        still = StillCamera(tmp_path_factory.mktemp("burst") / "tethered")
        still.picture((first - 2) % 9999 + 1)
        camera = opened(still, still_s=1e-9, patience_s=1e-9)
        camera.configure(EXPOSURE)
        camera.arm(2)
        sent = [(first + step - 1) % 9999 + 1 for step in range(20) if step not in lost]
        for number in sent:
            still.picture(number)
        ids = []
        for _ in sent:
            (frame,) = take(camera, 1)
            ids.append(frame.frame_id)
            frame.release()
        assert ids == sent
        assert camera.statistics().lost_transfers == len(lost)


class TestDecoding:
    """LibRaw's view of a file."""

    @pytest.mark.skipif(not REAL_DNG.exists(), reason="the reference DNG is not here")
    def test_a_real_cameras_file_is_decoded_without_its_masked_margins(self) -> None:
        pixels, frame_format = decode(REAL_DNG)
        assert frame_format == FrameFormat(1156, 1734, 14, "RGGB", 2056, 15_000)
        assert pixels.shape == (1156, 1734)
        assert 2056 < np.median(pixels) < 15_000

    def test_a_file_that_is_no_picture_is_refused(self, still: StillCamera) -> None:
        path = still.picture(42)
        path.write_bytes(path.read_bytes()[:300])
        with pytest.raises(ValueError, match="LibRaw says"):
            decode(path)


class TestSetting:
    """What the driver can and cannot tell the camera."""

    def test_marks_can_be_told_apart_at_the_least_period(self, still: StillCamera) -> None:
        camera = RawFiles(Settings(folder=still.folder, period_us=1), SystemClock())
        assert camera.timestamp_jitter_us == 10_000
        assert camera.min_period_us(EXPOSURE) == 400_000

    def test_a_camera_that_tells_whole_seconds_only_is_slow(self, still: StillCamera) -> None:
        still.picture(42, subseconds="")
        assert opened(still).min_period_us(EXPOSURE) == 40 * 505_000

    @pytest.mark.parametrize("subseconds", ["00", ""])
    def test_a_burst_at_the_least_period_is_proven_by_its_capture_times(
        self, still: StillCamera, subseconds: str
    ) -> None:
        still.picture(42, subseconds=subseconds)
        camera = RawFiles(Settings(folder=still.folder, period_us=1), SystemClock())
        log = _log_of_a_burst(camera.min_period_us(EXPOSURE))
        chance = np.random.default_rng(7)
        exposed_ns = log["t_trigger_ns"] * (1 + 80e-6) + 1.7e18 + chance.uniform(-5e6, 5e6, len(log))
        step_ns = 10**9 if not subseconds else 10**7
        taken_ns = exposed_ns.astype(np.int64) // step_ns * step_ns + step_ns // 2
        seen = np.setdiff1d(np.arange(len(log)), [3, 17, 30])
        ids = (9990 + seen) % 9999 + 1
        jitter = FaultModel(jitter_us=camera.timestamp_jitter_us + 20)
        found = match(log, ids, taken_ns[seen], id_modulus=camera.id_modulus, complete=True, model=jitter)
        assert np.array_equal(found.step_of_frame, seen)

    def test_a_gain_is_refused(self, still: StillCamera) -> None:
        with pytest.raises(DeviceRefused, match="Set ISO on the camera"):
            opened(still).configure(Exposure(8_000, gain_db=6.0))

    def test_arming_before_configuring_is_refused(self, still: StillCamera) -> None:
        with pytest.raises(DeviceRefused, match="configure"):
            opened(still).arm(8)

    def test_a_folder_without_a_picture_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(DeviceRefused, match="Take a picture"):
            opened(StillCamera(tmp_path / "tethered"))

    def test_a_folder_that_is_not_there_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(DeviceLost, match="correct `folder`"):
            RawFiles(Settings(folder=tmp_path / "nowhere", period_us=1), SystemClock())

    def test_a_command_releases_the_shutter(self, still: StillCamera, tmp_path: Path) -> None:
        released = tmp_path / "released"
        touch = f"import pathlib; pathlib.Path({str(released)!r}).touch()"
        camera = opened(still, release_command=(sys.executable, "-c", touch))
        camera.configure(BY_COMMAND)
        camera.arm(8)
        camera.trigger()
        assert released.exists()

    def test_a_command_that_fails_is_reported_with_its_own_words(self, still: StillCamera) -> None:
        camera = opened(still, release_command=(sys.executable, "-c", "raise SystemExit('no camera found')"))
        camera.configure(BY_COMMAND)
        with pytest.raises(DeviceRefused, match="code 1: no camera found"):
            camera.trigger()

    def test_a_software_trigger_needs_a_command(self, still: StillCamera) -> None:
        with pytest.raises(DeviceRefused, match="release_command"):
            opened(still).configure(BY_COMMAND)

    def test_a_software_trigger_is_refused_while_edges_trigger(self, camera: RawFiles) -> None:
        with pytest.raises(DeviceRefused, match="camera: expected"):
            camera.trigger()

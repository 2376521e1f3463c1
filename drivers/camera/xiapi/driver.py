"""XIMEA cameras (CB120 and other PCIe and USB models) over libm3api: `coupole.devices.Camera`.

**Not yet run on a camera**: the tests use a C stand-in for the library, written from its header.
docs/how-to/cb120-camera.md lists what must be checked on the real one.

*Buffers.* The transport carries 12-bit packed pixels; xiAPI unpacks them, in one pass over the image, into
page-aligned memory of the driver (XI_RAW16, XI_BP_SAFE, XI_IMG.bp). The driver copies nothing, and pixels are
valid until `release()`. The policy XI_BP_UNSAFE would avoid this pass. This mode is not used, because it gives
access to xiAPI's own ring, which "may be overwritten by device" (xiApi.h) while it is read.

*Queue.* Images wait in xiAPI's queue, oldest first, until a buffer of the driver is free. When the queue is full,
xiAPI drops images and counts them. Each dropped image leaves a gap in `acq_nframe`, the frame id.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from coupole.clock import Clock
from coupole.devices import CameraStatistics, Exposure, Frame, FrameFormat, Identity
from coupole.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.camera.frame_pool import FramePool, Slot
from drivers.camera.misuse import format_for_arming, misuse_error, refuse_while_armed
from drivers.camera.xiapi.device import XiDevice
from drivers.camera.xiapi.library import (
    API_SKIPPED,
    BAYER_PATTERNS,
    BUFFER_OVERFLOWS,
    BUFFERS_SAFE,
    GPI_TRIGGER,
    GPO_TRIGGER_WAIT,
    GPO_TRIGGER_WAIT_NEGATED,
    MISSED_BUFFER_FULL,
    MISSED_OVERLAP,
    RAW16,
    TRANSFERRED,
    TRANSPORT_SKIPPED,
    TRIGGER_FALLING,
    TRIGGER_OFF,
    TRIGGER_RISING,
    TRIGGER_SOFTWARE,
    Image,
)
from drivers.camera.xiapi.settings import Region, Settings
from drivers.camera.xiapi.state import AT_OPENING, FRAME_TRIGGER, State
from drivers.opening import closed_on_failure

_SLICE_S = 0.05
"""Longest wait for an image in one call. Other calls may have to wait this long."""
_LOOK_S = 1.0
"""Interval of checks whether a camera that sends no image is still there."""
_IN_HAND = 16
"""Greatest number of frames in memory on their way to the disk."""
_KIB = 1024
_COUNTERS = range(6)


class XiCamera:
    """A XIMEA camera, as `coupole.devices.Camera`."""

    id_modulus = (0, 2**32 - 1)
    delivery_s = 1.0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._name = settings, settings.device
        self.timestamp_jitter_us = settings.timestamp_jitter_us
        self._format: FrameFormat | None = None
        self._by_edges = True
        self._pool = FramePool(1, 1)
        self._armed = threading.Event()
        self._counted_before: dict[int, int] = {}
        self._last = CameraStatistics(-1, 0, -1, -1, -1)
        self._device = XiDevice(settings.library, settings.serial, settings.device)
        self._state = State(self._device, {*settings.parameters, *settings.leave})
        with closed_on_failure(self.close):
            self._set_up()
            self._readout_us = settings.readout_us or self._measure_readout_us()

    # -- opening and closing ------------------------------------------------------------------------------

    def _set_up(self) -> None:
        settings, device = self._settings, self._device
        state = self._state
        device.set("trigger_source", TRIGGER_OFF)
        state.apply(AT_OPENING)
        state.neutralise_gains()
        state.set("imgdataformat", RAW16)
        state.set_if_present("sensor_bit_depth", settings.bit_depth)
        state.set_if_present("output_bit_depth", settings.bit_depth)
        if settings.bit_depth > 8:
            state.set_if_present("output_bit_packing", int(settings.packed))
        if settings.region is not None:
            self._set_region(settings.region)
        else:
            state.use_whole_sensor()
        device.set("buffer_policy", BUFFERS_SAFE)
        device.set("recent_frame", 0)
        state.free_other_inputs(settings.trigger_input)
        state.set("gpi_selector", settings.trigger_input)
        state.set("gpi_mode", GPI_TRIGGER)
        state.apply(FRAME_TRIGGER)
        if settings.ready_output is not None:
            device.set("gpo_selector", settings.ready_output)
            device.set("gpo_mode", GPO_TRIGGER_WAIT_NEGATED if settings.ready_inverted else GPO_TRIGGER_WAIT)
        for parameter, setting in settings.parameters.items():
            device.set(parameter, setting)
        state.note(*(name for name, setting in settings.parameters.items() if not isinstance(setting, str)))
        state.note("width", "height", "offsetX", "offsetY", "image_black_level", "framerate")

    def _set_region(self, region: Region) -> None:
        """Set the region. Offsets are set to zero first, because offset and size limit each other."""
        for parameter, value in (
            ("offsetX", 0),
            ("offsetY", 0),
            ("width", region.width_px),
            ("height", region.height_px),
            ("offsetX", region.left_px),
            ("offsetY", region.top_px),
        ):
            self._device.set(parameter, value)

    def _measure_readout_us(self) -> int:
        """Return the sensor's shortest period: one over the largest frame rate at the shortest exposure."""
        self._device.set("exposure", math.ceil(self._device.bounds("exposure")[0]))
        rate_hz = self._device.bounds("framerate")[1]
        if not 0 < rate_hz < math.inf:
            raise DeviceRefused(
                self._name,
                expected="the largest frame rate in `framerate:max`",
                happened=f"the camera says {rate_hz:g}",
                remedy="Give `readout_us` in the camera's settings of the rig, from its data sheet.",
            )
        return math.ceil(1e6 / rate_hz - 1e-3)  # the rate is a 32-bit float

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()
        self._device.close()

    # -- who it is ----------------------------------------------------------------------------------------

    def identify(self) -> Identity:
        device = self._device
        versions = [
            f"{part} {device.text(parameter)}"
            for part, parameter in (("API", "api_version"), ("FPGA", "version_fpga1"))
            if device.has(parameter)
        ]
        firmware = ", ".join(versions) or "unknown"
        names = device.text("device_name"), device.text("device_sn")
        return Identity("XIMEA", *names, firmware, settings=self._state.held)

    def self_test(self) -> Mapping[str, str]:
        """Raises DeviceLost if the camera is gone."""
        self._check_presence()
        report = {"readout_us": str(self._readout_us)}
        for quantity, parameter in (
            ("sensor_c", "chip_temp"),
            ("sensor_board_c", "sensor_board_temp"),
            ("housing_c", "hous_temp"),
        ):
            if self._device.has(parameter):
                report[quantity] = f"{self._device.number(parameter):.1f}"
        return report

    def _check_presence(self) -> None:
        if self._device.has("isexist") and not self._device.whole("isexist"):
            raise DeviceLost(
                self._name,
                expected="a camera that is connected and works",
                happened="xiAPI reports that the camera is gone",
                remedy="Check cable and power, then resume the run.",
            )

    # -- exposure -----------------------------------------------------------------------------------------

    def configure(self, exposure: Exposure) -> FrameFormat:
        refuse_while_armed(self._name, is_armed=self._armed.is_set())
        device, settings = self._device, self._settings
        edge = TRIGGER_RISING if settings.trigger_edge == "rising" else TRIGGER_FALLING
        device.set("trigger_source", edge if exposure.hardware_trigger else TRIGGER_SOFTWARE)
        self._state.apply(FRAME_TRIGGER)
        device.set("exposure", exposure.exposure_us)
        self._check_exposure(exposure.exposure_us)
        device.set("gain", float(exposure.gain_db))
        self._by_edges = exposure.hardware_trigger
        self._format = self._frame_format()
        return self._format

    def _check_exposure(self, asked_us: int) -> None:
        got_us = self._device.number("exposure")
        if abs(got_us - asked_us) > max(30.0, 0.01 * asked_us):
            raise DeviceRefused(
                self._name,
                expected=f"an exposure of {asked_us} us",
                happened=f"the camera made {got_us:g} us of it",
                remedy="Choose an exposure that its sensor can do.",
            )

    def _frame_format(self) -> FrameFormat:
        device, bits = self._device, self._settings.bit_depth
        if device.has("image_data_bit_depth") and device.whole("image_data_bit_depth") != bits:
            raise DeviceRefused(
                self._name,
                expected=f"pixels of {bits} bits",
                happened=f"the camera gives {device.whole('image_data_bit_depth')}",
                remedy="Set `bit_depth` in the camera's settings of the rig.",
            )
        mosaic = device.whole("cfa")
        if mosaic not in BAYER_PATTERNS:
            raise DeviceRefused(
                self._name,
                expected="a Bayer or a monochrome sensor",
                happened=f"its colour filter array is number {mosaic} of XI_COLOR_FILTER_ARRAY",
                remedy="Use another camera.",
            )
        black_dn = self._settings.black_dn
        return FrameFormat(
            height_px=device.whole("height"),
            width_px=device.whole("width"),
            bit_depth=bits,
            bayer_pattern=BAYER_PATTERNS[mosaic],
            black_dn=device.whole("image_black_level") if black_dn is None else black_dn,
            white_dn=(1 << bits) - 1,
        )

    def min_period_us(self, exposure: Exposure) -> int:
        return max(self._readout_us, exposure.exposure_us + self._settings.exposure_gap_us)

    # -- acquisition --------------------------------------------------------------------------------------

    def arm(self, buffers: int) -> None:
        format_for_arming(self._name, self._format)
        self.disarm()
        self._check_presence()
        buffer_count = max(buffers, self._settings.buffers)
        image_bytes = self._device.whole("imgpayloadsize")
        queue_length = self._queue(buffer_count, image_bytes)
        slots = max(min(buffer_count, _IN_HAND), buffer_count - queue_length)
        if (self._pool.slots, self._pool.slot_bytes) != (slots, image_bytes):
            self._pool = FramePool(slots, image_bytes)
        self._pool.begin()
        self._device.start()
        self._counted_before = self._count()  # no edge comes before arm() returns
        self._armed.set()

    def _queue(self, images: int, image_bytes: int) -> int:
        """Let xiAPI queue `images` images, or as many as it can. Returns the number.

        Memory is requested for unpacked pixels, which is enough for packed ones too.
        """
        device = self._device
        if device.has("acq_buffer_size_unit"):  # in bytes, an int parameter is limited to 2 GiB
            device.set("acq_buffer_size_unit", _KIB)
            device.set("acq_buffer_size", math.ceil(images * image_bytes / _KIB))
        else:
            device.set("acq_buffer_size", images * image_bytes)
        queue_length = int(min(images, device.bounds("buffers_queue_size")[1]))
        device.set("buffers_queue_size", queue_length)
        return queue_length

    def next_frame(self, timeout_s: float) -> Frame | None:
        end_s = time.monotonic() + timeout_s
        look_s = time.monotonic() + _LOOK_S
        while True:
            left_s = max(0.0, end_s - time.monotonic())
            if self._armed.wait(left_s):
                frame = self._next_within(min(left_s, _SLICE_S))
                if frame is not None:
                    return frame
            now_s = time.monotonic()
            if now_s >= end_s:
                return None
            if now_s >= look_s:
                self._check_presence()
                look_s = now_s + _LOOK_S

    def _next_within(self, timeout_s: float) -> Frame | None:
        slot = self._pool.take(timeout_s)
        if slot is None:
            return None
        image = self._device.image(slot.memory.ctypes.data, slot.memory.size, timeout_s)
        if image is None:
            slot.release()
            return None
        return self._frame(image, slot)

    def _frame(self, image: Image, slot: Slot) -> Frame:
        """Raises DeviceRefused if the image differs from the format that `configure` returned."""
        assert self._format is not None
        frame_format = self._format
        actual_format = (image.height, image.width, image.frm)
        if actual_format != (frame_format.height_px, frame_format.width_px, RAW16):
            raise self._unexpected_image(
                f"{frame_format.height_px} x {frame_format.width_px} pixels, RAW16", str(actual_format)
            )
        if self._settings.black_dn is None and image.black_level != frame_format.black_dn:
            raise self._unexpected_image(f"a black level of {frame_format.black_dn} DN", f"{image.black_level} DN")
        return Frame(
            frame_id=image.acq_nframe,
            timestamp_ns=self._timestamp_ns(image),
            pixels=_pixels(slot.memory, frame_format, image.padding_x),
            release=slot.release,
        )

    def _timestamp_ns(self, image: Image) -> int:
        if self._settings.timestamps == "4ns":
            return int(4 * (image.tsSec << 32 | image.tsUSec))
        if image.tsUSec > 999_999:
            raise self._unexpected_image("a timestamp in seconds and microseconds", f"{image.tsUSec} us")
        return int(image.tsSec * 1_000_000_000 + image.tsUSec * 1_000)

    def trigger(self) -> None:
        if self._by_edges:  # xiAPI would expose a frame all the same (python-microscope/vendor-issues, issue 3)
            raise misuse_error(self._name, "hardware_trigger=False", "a software trigger while edges trigger")
        self._device.set("trigger_software", 1)

    def statistics(self) -> CameraStatistics:
        """Return statistics from xiAPI's counters, as described in xiApi.h; while disarmed, the statistics of the
        last acquisition."""
        if self._armed.is_set():
            self._last = self._statistics()
        return self._last

    def _statistics(self) -> CameraStatistics:
        counts = {
            counter: count - self._counted_before.get(counter, 0) for counter, count in self._count().items()
        }
        transfers, skip_count = counts.get(TRANSFERRED, -1), counts.get(API_SKIPPED, 0)
        losses = counts.get(TRANSPORT_SKIPPED, 0) + counts.get(BUFFER_OVERFLOWS, 0)
        trigger_misses = [counts[counter] for counter in (MISSED_OVERLAP, MISSED_BUFFER_FULL) if counter in counts]
        return CameraStatistics(
            exposed=-1 if transfers < 0 else transfers + losses,
            delivered=-1 if transfers < 0 else transfers - skip_count,
            lost_transfers=losses,
            over_triggers=sum(trigger_misses) if trigger_misses else -1,
            overflows=skip_count,
        )

    def _count(self) -> dict[int, int]:
        """The counters that this model has."""
        counts = {}
        for counter in _COUNTERS:
            with contextlib.suppress(DeviceRefused):
                self._device.set("counter_selector", counter)
                counts[counter] = self._device.whole("counter_value")
        return counts

    def disarm(self) -> None:
        if not self._armed.is_set():
            return
        try:
            self.statistics()
        finally:
            self._armed.clear()
            self._device.stop()

    # -- errors -------------------------------------------------------------------------------------------

    def _unexpected_image(self, expectation: str, observation: str) -> DeviceRefused:
        return DeviceRefused(
            self._name,
            expected=f"images with {expectation}",
            happened=f"one came with {observation}",
            remedy="Make both agree in the rig (`region`, `black_dn`, `timestamps`, `parameters`).",
        )


def _pixels(memory: NDArray[np.uint8], frame_format: FrameFormat, padding_bytes: int) -> NDArray[np.uint16]:
    """Return [height_px, width_px] in place. Padding at the ends of rows is removed first."""
    height, width_bytes = frame_format.height_px, 2 * frame_format.width_px
    if padding_bytes:
        rows = memory[: height * (width_bytes + padding_bytes)].reshape(height, width_bytes + padding_bytes)
        memory[: height * width_bytes] = rows[:, :width_bytes].reshape(-1)
    return memory[: height * width_bytes].view(np.uint16).reshape(height, frame_format.width_px)

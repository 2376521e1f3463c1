"""Cameras of a GenTL producer (.cti), over `harvesters` and `genicam`: `coupole.devices.Camera`.

The extra `gentl` installs both packages. The producer of any maker gives access to its cameras. Each pixel is
copied once, from the producer's buffer to page-aligned memory of the driver; 8-bit and packed pixels are widened
in the same step. The producer's buffer is queued again at once.

Tested with a producer written for the tests (tests/conformance/gentl_producer), and with the one in the package
genicam, which has no trigger. **Not yet tested with a real camera.**
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

from coupole.clock import Clock
from coupole.devices import CameraStatistics, Exposure, Frame, FrameFormat, Identity
from coupole.errors import DeviceError, DeviceRefused
from drivers.camera.frame_pool import FramePool, Slot
from drivers.camera.genicam_image import frame_format, pixel_format, readout_us, set_up
from drivers.camera.genicam_trigger import counts, frame_id_range, set_exposure, since
from drivers.camera.gentl.features import Features
from drivers.camera.gentl.image import copy_pixels, timestamp_ns
from drivers.camera.gentl.producer import Gaps, open_camera, optional_int, reporting, when_incomplete
from drivers.camera.gentl.settings import Settings
from drivers.camera.misuse import format_for_arming, misuse_error, refuse_while_armed
from drivers.fair_lock import FairLock
from drivers.opening import closed_on_failure

_A_LOOK_S = 1e-4
"""Shortest time-out that harvesters accepts. With a shorter time-out it may not poll at all, because its clock has
steps of 0.2 us."""
_NAP_S = 1e-3
"""Pause between polls for a frame: a blocking wait of genicam 1.6 would hold the GIL."""
_SILENCE_S = 0.5
"""Time without frames after which the camera is queried: not every producer reports a lost camera."""
_IN_HAND = 16
"""Greatest number of frames in memory on their way to the disk."""


class GenTLCamera:
    """A camera of a GenTL producer, as `coupole.devices.Camera`."""

    delivery_s = 1.0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._name, self._clock = settings, settings.device, clock
        self.timestamp_jitter_us = settings.timestamp_jitter_us
        self._format: FrameFormat | None = None
        self._exposure: Exposure | None = None
        self._pool = FramePool(1, 2)
        self._lock, self._armed = FairLock(), threading.Event()
        self._gaps = Gaps()
        self._counted_before = (0, 0)
        self._heard_s = 0.0
        self._last = CameraStatistics(-1, 0, 0, -1, 0)
        self._harvester, self._acquirer, self._info = open_camera(settings)
        with closed_on_failure(self.close):
            self._features = Features(self._acquirer.remote_device.node_map, self._name)
            self._acquirer.add_callback(
                self._acquirer.Events.INCOMPLETE_BUFFER, when_incomplete(self._gaps.incomplete)
            )
            self._acquirer.timeout_period_on_update_event_data_call = 0
            self._stop_what_runs()
            self._state = set_up(self._features, settings, is_triggered=not settings.free_running)
            self.id_modulus = frame_id_range(self._features, gige=self._info["tl_type"] == "GEV")

    # -- opening and closing ------------------------------------------------------------------------------

    def _stop_what_runs(self) -> None:
        """Stop a running acquisition and unlock the features that it locks; a client that died may have left
        both."""
        with contextlib.suppress(DeviceRefused):
            self._features.write("AcquisitionStop", True)
        if self._features.has("TLParamsLocked"):
            self._features.write("TLParamsLocked", 0)

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()
        with self._lock:
            with contextlib.suppress(DeviceError), reporting(self._name, "the camera to close"):
                self._acquirer.destroy()
            with contextlib.suppress(DeviceError), reporting(self._name, "the producer to close"):
                self._harvester.reset()

    # -- who it is ----------------------------------------------------------------------------------------

    def identify(self) -> Identity:
        vendor, model, serial, version = (
            self._info[key] or "unknown" for key in ("vendor", "model", "serial", "version")
        )
        return Identity(vendor, model, serial, version, settings=self._state)

    def self_test(self) -> Mapping[str, str]:
        """Raises DeviceError if the camera does not answer."""
        names = ("DeviceTemperature", "PixelFormat", "Width", "Height", "PayloadSize")
        with self._lock:
            return {name: str(self._features.read_value(name)) for name in names if self._features.has(name)}

    # -- exposure -----------------------------------------------------------------------------------------

    def configure(self, exposure: Exposure) -> FrameFormat:
        refuse_while_armed(self._name, is_armed=self._armed.is_set())
        with self._lock:
            if not self._settings.free_running:
                self._expect_trigger()
                set_exposure(self._features, self._settings, exposure)
            self._format = frame_format(self._features, self._name, self._settings.black_dn)
        self._exposure = exposure
        return self._format

    def _expect_trigger(self) -> None:
        if not self._features.has("TriggerMode"):
            raise DeviceRefused(
                self._name,
                expected="a camera that can be triggered",
                happened="it has no feature `TriggerMode`",
                remedy="Use another camera, or set `free_running: true` to view images of this one.",
            )

    def min_period_us(self, exposure: Exposure) -> int:
        with self._lock:
            readout = readout_us(self._features, self._name, self._settings.readout_us)
        return max(readout, exposure.exposure_us + self._settings.exposure_gap_us)

    # -- acquisition --------------------------------------------------------------------------------------

    def arm(self, buffers: int) -> None:
        frame_format = format_for_arming(self._name, self._format)
        self.disarm()
        buffer_count = max(buffers, self._settings.buffers, self._acquirer.min_num_buffers)
        slots = min(buffer_count, _IN_HAND)
        if (self._pool.slots, self._pool.slot_bytes) != (slots, frame_format.frame_bytes):
            self._pool = FramePool(slots, frame_format.frame_bytes)
        self._pool.begin()
        with self._lock:
            self._wire_format = pixel_format(self._features, self._name)
            self._gaps.begin(self.id_modulus)
            self._counted_before = counts(self._features, self._settings)
            with reporting(self._name, "the acquisition to start"):
                self._acquirer.num_buffers = buffer_count
                self._acquirer.start()
            self._heard_s = time.monotonic()
            self._armed.set()

    def next_frame(self, timeout_s: float) -> Frame | None:
        end_s = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, end_s - time.monotonic())
            if self._armed.wait(left_s):
                slot = self._pool.take(left_s)
                frame = self._fetch(slot) if slot is not None else None
                if frame is not None:
                    self._heard_s = time.monotonic()
                    return frame
                self._listen()
            if time.monotonic() >= end_s:
                return None
            time.sleep(_NAP_S)

    def _listen(self) -> None:
        """Raises DeviceLost if no frame has come for a long time and the camera does not answer."""
        if time.monotonic() > self._heard_s + _SILENCE_S:
            with self._lock:
                if self._armed.is_set():
                    self._features.expect_answer()
            self._heard_s = time.monotonic()

    def _fetch(self, slot: Slot) -> Frame | None:
        """Return the oldest complete image, copied to `slot`. None if there is no image; the slot is then
        released."""
        with self._lock, reporting(self._name, "an image"):
            buffer = self._acquirer.try_fetch(timeout=_A_LOOK_S, is_raw=True) if self._armed.is_set() else None
            if buffer is None:
                slot.release()
                return None
            try:
                return self._frame(buffer, slot)
            finally:
                buffer.parent.queue_buffer(buffer)

    def _frame(self, buffer: Any, slot: Slot) -> Frame:
        assert self._format is not None
        pixels = copy_pixels(buffer, slot.memory, self._format, self._wire_format, self._name)
        self._gaps.whole(int(buffer.frame_id))
        by_host = self._settings.timestamps == "host"
        stamp_ns = self._clock.now_ns() if by_host else timestamp_ns(buffer, self._acquirer.device, self._name)
        return Frame(int(buffer.frame_id), stamp_ns, pixels, slot.release)

    def trigger(self) -> None:
        if self._settings.free_running or self._exposure is None or self._exposure.hardware_trigger:
            raise misuse_error(
                self._name,
                "hardware_trigger=False",
                "a software trigger, but the camera is set to another trigger",
            )
        with self._lock:
            self._features.write("TriggerSoftware", True)

    def statistics(self) -> CameraStatistics:
        """Counts of the present acquisition; while disarmed, the counts of the last acquisition."""
        if self._armed.is_set():
            with self._lock, reporting(self._name, "the camera's counters"):
                self._last = self._statistics()
        return self._last

    def _statistics(self) -> CameraStatistics:
        exposures, over_triggers = counts(self._features, self._settings)
        missing = self._gaps.missing
        overflows = min(missing, int(optional_int(self._acquirer.data_streams[0].module, "num_underrun") or 0))
        return CameraStatistics(
            exposed=since(exposures, self._counted_before[0]),
            delivered=self._gaps.delivered,
            lost_transfers=missing - overflows,
            over_triggers=since(over_triggers, self._counted_before[1]),
            overflows=overflows,
        )

    def disarm(self) -> None:
        if not self._armed.is_set():
            return
        try:
            self.statistics()
        finally:
            self._armed.clear()
            with self._lock, reporting(self._name, "the acquisition to stop"):
                self._acquirer.stop()

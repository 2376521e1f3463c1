"""Cameras behind a GenTL producer (.cti), through `harvesters` and `genicam`: `coupole.devices.Camera`.

The extra `gentl` installs both. Any maker's producer gives access to its cameras; each pixel is copied once, from
the producer's buffer into page-aligned memory of ours, 8-bit and packed ones widened on the way, and the producer
gets its buffer back at once.

What the tests have run is the producer that the package genicam ships (no trigger, no timestamps), so triggers,
counters and camera timestamps have **never been seen working** here.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import CameraStatistics, Clock, Exposure, Frame, FrameFormat, Identity
from coupole.errors import DeviceError, DeviceRefused
from drivers.aravis_pixels import FORMATS, PixelFormat, pixels_in_a_group, widen
from drivers.frame_pool import FramePool, Slot
from drivers.gentl_features import Features
from drivers.gentl_producer import Gaps, open_camera, reporting, told, when_incomplete
from drivers.gentl_settings import Counter, Region, Settings
from drivers.turns import Turns

_NO_WAIT_S = 1e-9
_NAP_S = 1e-3
"""Between two looks for a frame: genicam 1.6 would keep all of Python waiting while it waits."""
_IN_HAND = 16
"""Frames that are on their way to the disk at once."""
_LAST_WIDE_ID = 2**62
"""Stands for the end of 64-bit ids, which is never reached."""
_PLAIN_IMAGE = 1
"""PAYLOAD_TYPE_IMAGE of the GenTL standard."""


class GenTLCamera:
    """`coupole.devices.Camera`; see the module's text."""

    delivery_s = 1.0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._name, self._clock = settings, settings.device, clock
        self.timestamp_jitter_us = settings.timestamp_jitter_us
        self._format: FrameFormat | None = None
        self._exposure: Exposure | None = None
        self._pool = FramePool(1, 2)
        self._turns, self._armed = Turns(), threading.Event()
        self._gaps = Gaps()
        self._counted_before = (0, 0)
        self._last = CameraStatistics(-1, 0, 0, -1, 0)
        self._harvester, self._acquirer, self._info = open_camera(settings)
        try:
            self._features = Features(self._acquirer.remote_device.node_map, self._name)
            self._acquirer.add_callback(
                self._acquirer.Events.INCOMPLETE_BUFFER, when_incomplete(self._gaps.incomplete)
            )
            self._acquirer.timeout_period_on_update_event_data_call = 0
            self._set_up()
            self.id_modulus = self._ids()
        except BaseException:
            self.close()
            raise

    # -- opening and closing ------------------------------------------------------------------------------

    def _set_up(self) -> None:
        self._features.write_all(self._settings.features)
        if self._settings.region is not None:
            self._set_region(self._settings.region)
        self._features.write("PixelFormat", self._settings.pixel_format)

    def _set_region(self, region: Region) -> None:
        """Offsets first to zero: they bound the size, and the size bounds them."""
        for name, value in (
            ("OffsetX", 0),
            ("OffsetY", 0),
            ("Width", region.width_px),
            ("Height", region.height_px),
            ("OffsetX", region.left_px),
            ("OffsetY", region.top_px),
        ):
            if value or self._features.has(name):
                self._features.write(name, value)

    def _ids(self) -> tuple[int, int]:
        """16 bits on GigE Vision, unless the camera says that it uses the extended ones; else 64."""
        if self._info["tl_type"] != "GEV":
            return (0, _LAST_WIDE_ID)
        extended = "GevGVSPExtendedIDMode"
        wide = self._features.has(extended) and self._features.read(extended) in {"On", True}
        return (1, _LAST_WIDE_ID if wide else 65535)

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()
        with self._turns.mine():
            self._acquirer.destroy()
            self._harvester.reset()

    # -- who it is ----------------------------------------------------------------------------------------

    def identify(self) -> Identity:
        vendor, model, serial, version = (
            self._info[what] or "unknown" for what in ("vendor", "model", "serial", "version")
        )
        return Identity(vendor, model, serial, version)

    def self_test(self) -> Mapping[str, str]:
        """Raises DeviceError if the camera does not answer."""
        names = ("DeviceTemperature", "PixelFormat", "Width", "Height", "PayloadSize")
        with self._turns.mine():
            return {name: str(self._features.read(name)) for name in names if self._features.has(name)}

    # -- exposure -----------------------------------------------------------------------------------------

    def configure(self, exposure: Exposure) -> FrameFormat:
        if self._armed.is_set():
            raise self._misused("a disarmed camera", "configure() was called while it is armed")
        with self._turns.mine():
            if not self._settings.free_running:
                self._set_exposure(exposure)
            self._format = self._frame_format()
        self._exposure = exposure
        return self._format

    def _set_exposure(self, exposure: Exposure) -> None:
        features, settings = self._features, self._settings
        if not features.has("TriggerMode"):
            raise DeviceRefused(
                self._name,
                expected="a camera that can be triggered",
                happened="it has no feature `TriggerMode`",
                remedy="Use another camera, or set `free_running: true` to look through this one.",
            )
        for name, entry in (("ExposureAuto", "Off"), ("GainAuto", "Off"), ("TriggerSelector", "FrameStart")):
            if features.has(name):
                features.write(name, entry)
        features.write("TriggerMode", "On")
        by_edges = exposure.hardware_trigger
        features.write("TriggerSource", settings.trigger_line if by_edges else settings.software_trigger)
        if by_edges and features.has("TriggerActivation"):
            features.write("TriggerActivation", settings.trigger_activation)
        features.write(features.first_of("ExposureTimeAbs") or "ExposureTime", float(exposure.exposure_us))
        if exposure.gain_db or features.has("Gain"):
            features.write("Gain", float(exposure.gain_db))

    def _frame_format(self) -> FrameFormat:
        features, pixel_format = self._features, self._pixel_format()
        width_px, height_px = int(features.number("Width")), int(features.number("Height"))
        if width_px * height_px % pixels_in_a_group(pixel_format):
            raise DeviceRefused(
                self._name,
                expected=f"an image whose pixels fill whole bytes in {pixel_format.name}",
                happened=f"it has {width_px} x {height_px}",
                remedy="Choose another region or pixel format in the rig.",
            )
        black_dn = self._settings.black_dn
        if black_dn is None:
            black_dn = round(features.number("BlackLevel")) if features.has("BlackLevel") else 0
        bits = pixel_format.bit_depth
        return FrameFormat(height_px, width_px, bits, pixel_format.bayer_pattern, black_dn, (1 << bits) - 1)

    def _pixel_format(self) -> PixelFormat:
        name = str(self._features.read("PixelFormat"))
        if name not in FORMATS:
            raise DeviceRefused(
                self._name,
                expected="a Bayer or mono format of 8 to 16 bits",
                happened=f"it sends {name}",
                remedy=f"Choose one of {', '.join(FORMATS)} for `pixel_format` in the rig.",
            )
        return FORMATS[name]

    def min_period_us(self, exposure: Exposure) -> int:
        return max(self._readout_us(), exposure.exposure_us + self._settings.exposure_gap_us)

    def _readout_us(self) -> int:
        if self._settings.readout_us is not None:
            return self._settings.readout_us
        with self._turns.mine():
            if self._features.has("SensorReadoutTime"):
                return int(np.ceil(self._features.number("SensorReadoutTime")))
            if self._features.has("AcquisitionFrameRate"):
                return int(np.ceil(1e6 / self._features.bounds("AcquisitionFrameRate")[1]))
        raise DeviceRefused(
            self._name,
            expected="the camera's readout time",
            happened="it has neither `SensorReadoutTime` nor `AcquisitionFrameRate`",
            remedy="Give `readout_us` in the camera's settings of the rig, from its data sheet.",
        )

    # -- acquisition --------------------------------------------------------------------------------------

    def arm(self, buffers: int) -> None:
        if self._format is None:
            raise self._misused("configure() before arm()", "no exposure is set")
        self.disarm()
        wanted = max(buffers, self._settings.buffers)
        slots = min(wanted, _IN_HAND)
        if (self._pool.slots, self._pool.slot_bytes) != (slots, self._format.frame_bytes):
            self._pool = FramePool(slots, self._format.frame_bytes)
        self._pool.begin()
        with self._turns.mine():
            self._wire_format = self._pixel_format()
            self._gaps.begin(self.id_modulus)
            self._counted_before = self._count()
            with reporting(self._name, "the acquisition to start"):
                self._acquirer.num_buffers = wanted
                self._acquirer.start()
            self._armed.set()

    def next_frame(self, timeout_s: float) -> Frame | None:
        end_s = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, end_s - time.monotonic())
            if self._armed.wait(left_s):
                slot = self._pool.take(left_s)
                frame = self._fetch(slot) if slot is not None else None
                if frame is not None:
                    return frame
            if time.monotonic() >= end_s:
                return None
            time.sleep(_NAP_S)

    def _fetch(self, slot: Slot) -> Frame | None:
        """The oldest whole image that has come, in `slot`; None, and the slot is free again, if there is none."""
        with self._turns.mine(), reporting(self._name, "an image"):
            buffer = self._acquirer.try_fetch(timeout=_NO_WAIT_S, is_raw=True) if self._armed.is_set() else None
            if buffer is None:
                slot.release()
                return None
            try:
                return self._frame(buffer, slot)
            finally:
                buffer.parent.queue_buffer(buffer)

    def _frame(self, buffer: Any, slot: Slot) -> Frame:
        """Raises DeviceRefused for an image that is not what `configure` promised."""
        assert self._format is not None
        promised, wire = self._format, self._wire_format
        wanted = {
            "payload_type": _PLAIN_IMAGE,
            "height": promised.height_px,
            "width": promised.width_px,
            "pixel_format": wire.code,
            "padding_x": 0,
        }
        for what, value in wanted.items():
            seen = told(buffer, what)
            if seen not in {None, value}:
                raise DeviceRefused(
                    self._name,
                    expected=f"images with {what} {value}",
                    happened=f"one came with {seen}",
                    remedy="Set the camera up in the rig so that it sends plain images of one size and format.",
                )
        offset = told(buffer, "image_offset") or 0
        wire_bytes = wire.wire_bytes(promised.height_px * promised.width_px)
        data = np.frombuffer(buffer.raw_buffer, np.uint8, wire_bytes, offset)
        pixels = slot.memory.view(np.uint16)
        _copy(pixels, data, wire)
        self._gaps.whole(int(buffer.frame_id))
        return Frame(
            frame_id=int(buffer.frame_id),
            timestamp_ns=self._timestamp_ns(buffer),
            pixels=pixels.reshape(promised.height_px, promised.width_px),
            release=slot.release,
        )

    def _timestamp_ns(self, buffer: Any) -> int:
        if self._settings.timestamps == "host":
            return self._clock.now_ns()
        stamp_ns = told(buffer, "timestamp_ns")
        if stamp_ns is None:
            raise DeviceRefused(
                self._name,
                expected="timestamps in nanoseconds from the producer",
                happened="it gives none",
                remedy="Set `timestamps: host` to look through this camera; shots cannot be proven with it.",
            )
        return stamp_ns

    def trigger(self) -> None:
        if self._settings.free_running or self._exposure is None or self._exposure.hardware_trigger:
            raise self._misused("hardware_trigger=False", "a software trigger while something else triggers")
        with self._turns.mine():
            self._features.write("TriggerSoftware", True)

    def statistics(self) -> CameraStatistics:
        """At rest: those of the last acquisition."""
        if self._armed.is_set():
            with self._turns.mine(), reporting(self._name, "the camera's counters"):
                self._last = self._statistics()
        return self._last

    def _statistics(self) -> CameraStatistics:
        exposed, over_triggers = self._count()
        missing = self._gaps.missing
        overflows = min(missing, int(told(self._acquirer.data_streams[0].module, "num_underrun") or 0))
        return CameraStatistics(
            exposed=_since(exposed, self._counted_before[0]),
            delivered=self._gaps.delivered,
            lost_transfers=missing - overflows,
            over_triggers=_since(over_triggers, self._counted_before[1]),
            overflows=overflows,
        )

    def _count(self) -> tuple[int, int]:
        """The camera's own counts, -1 where it has none."""
        return (self._read(self._settings.exposed_counter), self._read(self._settings.over_trigger_counter))

    def _read(self, counter: Counter | None) -> int:
        if counter is None:
            return -1
        self._features.write_all(counter.select)
        return int(self._features.number(counter.read))

    def disarm(self) -> None:
        if not self._armed.is_set():
            return
        try:
            self.statistics()
        finally:
            self._armed.clear()
            with self._turns.mine(), reporting(self._name, "the acquisition to stop"):
                self._acquirer.stop()

    # -- errors -------------------------------------------------------------------------------------------

    def _misused(self, expected: str, happened: str) -> DeviceRefused:
        return DeviceRefused(
            self._name,
            expected=expected,
            happened=happened,
            remedy="This is a fault of the program that drives the camera.",
        )


def _since(count: int, before: int) -> int:
    return count if count < 0 else count - before


def _copy(pixels: NDArray[np.uint16], data: NDArray[np.uint8], wire: PixelFormat) -> None:
    if wire.packing == "two bytes":
        pixels[:] = data.view("<u2")
    else:
        widen(pixels, data, wire)

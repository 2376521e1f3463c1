"""GigE Vision and USB3 Vision cameras over libaravis: `coupole.devices.Camera`.

The camera is found by its address, serial number or Aravis id. At opening, the rig's `features` are checked,
written and read back, in their order. Frames are views of page-aligned buffers of the driver and are not copied
(packed and 8-bit formats are widened once). Counts that the camera does not provide are -1. The settings are
listed in `docs/reference/camera-aravis.md`.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from functools import partial

import numpy as np

from coupole.clock import Clock
from coupole.devices import CameraStatistics, Exposure, Frame, FrameFormat, Identity
from coupole.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.camera.aravis.discovery import name_of, open_controlled
from drivers.camera.aravis.features import Features
from drivers.camera.aravis.library import ON_CONTROL_LOST, call, is_a, require
from drivers.camera.aravis.settings import Settings
from drivers.camera.aravis.stream import Pool, Stream
from drivers.camera.genicam_image import frame_format, pixel_format, readout_us, set_up
from drivers.camera.genicam_trigger import counts, frame_id_range, set_exposure, since
from drivers.camera.misuse import format_for_arming, misuse_error, refuse_while_armed
from drivers.camera.pixel_formats import widen
from drivers.opening import closed_on_failure

__all__ = ["AravisCamera", "Settings"]

_PACKET_SOCKET_DISABLED = 1
"""ArvGvStreamOption (arvgvstream.h)."""


class AravisCamera:
    """A camera over libaravis, as `coupole.devices.Camera`."""

    delivery_s = 1.0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._name = settings, settings.device
        self.timestamp_jitter_us = settings.timestamp_jitter_us
        self._library = require(self._name)
        self._lost = threading.Event()
        self._format: FrameFormat | None = None
        self._exposure = Exposure(0)
        self._stream: Stream | None = None
        self._counted_before = (0, 0)
        self._last = CameraStatistics(-1, 0, 0, -1, 0)
        self._raw = self._wide = Pool(1, 1)
        self._armed = threading.Event()
        self._arming = threading.Lock()
        self._handle = open_controlled(self._library, self._name, name_of(self._name, settings.address))
        self._is_gige = is_a(self._library, self._handle, "arv_gv_device")
        self._on_lost = ON_CONTROL_LOST(lambda *_: self._lost.set())  # libaravis keeps no reference
        self._signal = self._library.g_signal_connect_data(
            self._handle, b"control-lost", self._on_lost, None, None, 0
        )
        self._features = Features(self._library, self._handle, self._name)
        with closed_on_failure(self.close):
            self._set_up()
            self.id_modulus = frame_id_range(self._features, gige=self._is_gige)

    # -- opening and closing ------------------------------------------------------------------------------

    def _set_up(self) -> None:
        # an earlier client that died may have left an acquisition running
        with contextlib.suppress(DeviceRefused):
            self._features.execute("AcquisitionStop")
        if self._is_gige:
            self._set_packets()
        self._state = set_up(self._features, self._settings, is_triggered=True)

    def _set_packets(self) -> None:
        library, handle, size = self._library, self._handle, self._settings.packet_size
        if not self._settings.packet_socket:
            library.arv_gv_device_set_stream_options(handle, _PACKET_SOCKET_DISABLED)
        if size is None:
            call(self._name, "a packet size that fits", library.arv_gv_device_auto_packet_size, handle)
        else:
            call(self._name, f"packets of {size} B", library.arv_gv_device_set_packet_size, handle, size)

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()
        if self._handle:
            self._library.g_signal_handler_disconnect(self._handle, self._signal)
            self._library.g_object_unref(self._handle)
            self._handle = 0

    # -- who it is ----------------------------------------------------------------------------------------

    def identify(self) -> Identity:
        vendor, model, serial, firmware = (
            self._text(*names)
            for names in (
                ("DeviceVendorName",),
                ("DeviceModelName",),
                ("DeviceSerialNumber", "DeviceID"),
                ("DeviceFirmwareVersion", "DeviceVersion"),
            )
        )
        return Identity(vendor, model, serial, firmware, simulated=serial.startswith("SIM"), settings=self._state)

    def _text(self, *names: str) -> str:
        name = self._features.first_of(*names)
        return str(self._features.read_value(name)) if name else "unknown"

    def self_test(self) -> Mapping[str, str]:
        """Raises DeviceError if the camera does not answer."""
        self._check_link()
        report = {"protocol": "GigE Vision" if self._is_gige else "USB3 Vision"}
        for quantity, names in (
            ("temperature_c", ("DeviceTemperature", "DeviceTemperatureRaw")),
            ("pixel_format", ("PixelFormat",)),
            ("payload_bytes", ("PayloadSize",)),
            ("packet_bytes", ("GevSCPSPacketSize",)),
        ):
            name = self._features.first_of(*names)
            if name is not None:
                report[quantity] = str(self._features.read_value(name))
        return report

    # -- exposure -----------------------------------------------------------------------------------------

    def configure(self, exposure: Exposure) -> FrameFormat:
        refuse_while_armed(self._name, is_armed=self._stream is not None)
        self._check_link()
        set_exposure(self._features, self._settings, exposure)
        self._exposure = exposure
        self._format = frame_format(self._features, self._name, self._settings.black_dn)
        return self._format

    def min_period_us(self, exposure: Exposure) -> int:
        settings = self._settings
        least_us = readout_us(self._features, self._name, settings.readout_us)
        return max(least_us, exposure.exposure_us + settings.exposure_gap_us)

    # -- acquisition --------------------------------------------------------------------------------------

    def arm(self, buffers: int) -> None:
        format_for_arming(self._name, self._format)
        self.disarm()
        self._check_link()
        self._allocate(max(buffers, self._settings.buffers))
        retention_us = self._settings.frame_retention_ms * 1000
        stream = Stream(self._library, self._handle, self._name, self._raw, frame_retention_us=retention_us)
        with closed_on_failure(stream.close):
            self._counted_before = counts(self._features, self._settings)
            self._features.execute("AcquisitionStart")
        self._stream = stream
        self._armed.set()

    def _allocate(self, slots: int) -> None:
        """Allocate buffers of the camera's `PayloadSize`, which may be larger than the pixel format requires."""
        assert self._format is not None
        self._wire_format = pixel_format(self._features, self._name)
        payload_bytes = int(self._features.number("PayloadSize"))
        pixels = self._format.width_px * self._format.height_px
        if payload_bytes < self._wire_format.wire_bytes(pixels):
            raise DeviceRefused(
                self._name,
                expected=f"a payload of {self._wire_format.wire_bytes(pixels)} B or more",
                happened=f"the camera announces {payload_bytes} B",
                remedy="Check width, height and pixel format in the rig.",
            )
        if not self._raw.fits(slots, payload_bytes):
            self._raw = Pool(slots, payload_bytes)
        widens = self._wire_format.packing != "two bytes"
        if widens and (self._wide.slots, self._wide.payload_bytes) != (self._raw.slots, 2 * pixels):
            self._wide = Pool(self._raw.slots, 2 * pixels)

    def next_frame(self, timeout_s: float) -> Frame | None:
        end_s = time.monotonic() + timeout_s
        while True:
            left_s = end_s - time.monotonic()
            if self._lost.is_set():
                raise self._link_lost("its control channel is gone")
            stream = self._stream
            if stream is None:
                self._armed.wait(max(0.0, left_s))
                stream = self._stream
            image = stream.next(max(0.0, end_s - time.monotonic()), *self.id_modulus) if stream else None
            if image is not None:
                assert stream is not None
                return self._frame(stream, image.buffer, image.slot, image.frame_id, image.timestamp_ns)
            if time.monotonic() >= end_s:
                return None

    def _frame(self, stream: Stream, buffer: int, slot: int, frame_id: int, timestamp_ns: int) -> Frame:
        assert self._format is not None
        shape = (self._format.height_px, self._format.width_px)
        raw = self._raw.slot(slot)
        got = (
            self._library.arv_buffer_get_image_height(buffer),
            self._library.arv_buffer_get_image_width(buffer),
            self._library.arv_buffer_get_image_pixel_format(buffer),
        )
        if got != (*shape, self._wire_format.code):
            stream.give_back(buffer)
            raise DeviceError(
                self._name,
                expected=f"{shape[1]} x {shape[0]} pixels of {self._wire_format.name}",
                happened=f"frame {frame_id} has {got[1]} x {got[0]} of format 0x{got[2]:08x}",
                remedy="Check that no other program changes the camera's settings, then start again.",
            )
        if self._wire_format.packing == "two bytes":
            pixels = raw[: 2 * shape[0] * shape[1]].view(np.uint16).reshape(shape)
        else:
            pixels = self._wide.slot(slot).view(np.uint16).reshape(shape)
            widen(pixels.reshape(-1), raw, self._wire_format)
        return Frame(frame_id, timestamp_ns, pixels, partial(stream.give_back, buffer))

    def trigger(self) -> None:
        if self._stream is None or self._exposure.hardware_trigger:
            raise misuse_error(
                self._name, "a camera armed for the software trigger", "it is disarmed, or armed for the cable"
            )
        self._check_link()
        self._features.execute("TriggerSoftware")

    def disarm(self) -> None:
        with self._arming:
            stream, self._stream = self._stream, None
            self._armed.clear()
            if stream is None:
                return
            try:
                self._check_link()
                self._last = self._statistics(stream)
                self._features.execute("AcquisitionStop")
            finally:
                stream.close()

    # -- statistics ---------------------------------------------------------------------------------------

    def statistics(self) -> CameraStatistics:
        stream = self._stream
        return self._statistics(stream) if stream is not None else self._last

    def _statistics(self, stream: Stream) -> CameraStatistics:
        exposures, over_triggers = counts(self._features, self._settings)
        statistics = stream.statistics()
        overflows = max(0, statistics.skipped_ids - statistics.incomplete_images) if statistics.underruns else 0
        return CameraStatistics(
            since(exposures, self._counted_before[0]),
            statistics.complete_images,
            statistics.skipped_ids - overflows,
            since(over_triggers, self._counted_before[1]),
            overflows,
        )

    # -- errors -------------------------------------------------------------------------------------------

    def _check_link(self) -> None:
        if self._lost.is_set() or not self._handle:
            raise self._link_lost("its control channel is gone" if self._handle else "it was closed")

    def _link_lost(self, observation: str) -> DeviceLost:
        return DeviceLost(
            self._name,
            expected="control of the camera",
            happened=observation,
            remedy="Check cable and power, and that no other program uses the camera; then resume the run.",
        )

"""Images behind a GenTL producer: what the camera's features say of them, and what a buffer brings."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.errors import DeviceRefused
from drivers.aravis_pixels import FORMATS, PixelFormat, pixels_in_a_group, widen
from drivers.gentl_features import Features
from drivers.gentl_producer import told
from drivers.gentl_settings import Region

_PLAIN_IMAGE = 1
"""PAYLOAD_TYPE_IMAGE of the GenTL standard."""


def set_region(features: Features, region: Region) -> None:
    """Offsets go to zero first: they bound the size, and the size bounds them."""
    for name, value in (
        ("OffsetX", 0),
        ("OffsetY", 0),
        ("Width", region.width_px),
        ("Height", region.height_px),
        ("OffsetX", region.left_px),
        ("OffsetY", region.top_px),
    ):
        if value or features.has(name):
            features.write(name, value)


def pixel_format(features: Features, device: str) -> PixelFormat:
    """The format that the camera sends now. Raises DeviceRefused for one that the driver does not know."""
    name = str(features.read("PixelFormat"))
    if name not in FORMATS:
        raise DeviceRefused(
            device,
            expected="a Bayer or mono format of 8 to 16 bits",
            happened=f"it sends {name}",
            remedy=f"Choose one of {', '.join(FORMATS)} for `pixel_format` in the rig.",
        )
    return FORMATS[name]


def frame_format(features: Features, device: str, black_dn: int | None) -> FrameFormat:
    """Of the camera's frames; `black_dn` None stands for what `BlackLevel` holds. Raises DeviceRefused."""
    sent = pixel_format(features, device)
    width_px, height_px = int(features.number("Width")), int(features.number("Height"))
    if width_px * height_px % pixels_in_a_group(sent):
        raise DeviceRefused(
            device,
            expected=f"an image whose pixels fill whole bytes in {sent.name}",
            happened=f"it has {width_px} x {height_px}",
            remedy="Choose another region or pixel format in the rig.",
        )
    if black_dn is None:
        black_dn = round(features.number("BlackLevel")) if features.has("BlackLevel") else 0
    white_dn = (1 << sent.bit_depth) - 1
    return FrameFormat(height_px, width_px, sent.bit_depth, sent.bayer_pattern, black_dn, white_dn)


def readout_us(features: Features, device: str, given_us: int | None) -> int:
    """Least time between two frames, us: as given, as the camera says, or by its greatest frame rate."""
    if given_us is not None:
        return given_us
    if features.has("SensorReadoutTime"):
        return math.ceil(features.number("SensorReadoutTime"))
    if features.has("AcquisitionFrameRate"):
        return math.ceil(1e6 / features.bounds("AcquisitionFrameRate")[1])
    raise DeviceRefused(
        device,
        expected="the camera's readout time",
        happened="it has neither `SensorReadoutTime` nor `AcquisitionFrameRate`",
        remedy="Give `readout_us` in the camera's settings of the rig, from its data sheet.",
    )


def copy_pixels(
    buffer: Any, memory: NDArray[np.uint8], promised: FrameFormat, wire: PixelFormat, device: str
) -> NDArray[np.uint16]:
    """A buffer's image as 16-bit pixels [height_px, width_px] in `memory` [frame_bytes].

    Raises DeviceRefused for an image that is not what `configure` promised.
    """
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
                device,
                expected=f"images with {what} {value}",
                happened=f"one came with {seen}",
                remedy="Set the camera up in the rig so that it sends plain images of one size and format.",
            )
    offset = told(buffer, "image_offset") or 0
    wire_bytes = wire.wire_bytes(promised.height_px * promised.width_px)
    data = np.frombuffer(buffer.raw_buffer, np.uint8, wire_bytes, offset)
    pixels = memory.view(np.uint16)
    if wire.packing == "two bytes":
        pixels[:] = data.view("<u2")
    else:
        widen(pixels, data, wire)
    return pixels.reshape(promised.height_px, promised.width_px)


def timestamp_ns(buffer: Any, camera: Any, device: str) -> int:
    """When the camera says that a buffer's exposure began; older producers count ticks, and `camera` says of how
    long. Raises DeviceRefused where neither is told."""
    stamp_ns = told(buffer, "timestamp_ns")
    if stamp_ns is not None:
        return stamp_ns
    ticks, ticks_hz = told(buffer, "timestamp"), told(camera, "timestamp_frequency")
    if ticks is None or not ticks_hz:
        raise DeviceRefused(
            device,
            expected="timestamps from the producer, in nanoseconds or with their frequency",
            happened="it gives none",
            remedy="Set `timestamps: host` to look through this camera; shots cannot be proven with it.",
        )
    return ticks * 10**9 // ticks_hz

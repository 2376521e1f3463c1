"""Pixels and timestamp of a GenTL buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.errors import DeviceRefused
from drivers.camera.gentl.producer import optional_int
from drivers.camera.pixel_formats import PixelFormat, widen

_PLAIN_IMAGE = 1
"""PAYLOAD_TYPE_IMAGE of the GenTL standard."""


def copy_pixels(
    buffer: Any, memory: NDArray[np.uint8], expected_format: FrameFormat, wire: PixelFormat, device: str
) -> NDArray[np.uint16]:
    """Return a buffer's image as 16-bit pixels [height_px, width_px] in `memory` [frame_bytes].

    Raises DeviceRefused if the image differs from the format that `configure` returned.
    """
    expectations = {
        "payload_type": _PLAIN_IMAGE,
        "height": expected_format.height_px,
        "width": expected_format.width_px,
        "pixel_format": wire.code,
        "padding_x": 0,
    }
    for attribute, value in expectations.items():
        actual = optional_int(buffer, attribute)
        if actual not in {None, value}:
            raise DeviceRefused(
                device,
                expected=f"images with {attribute} {value}",
                happened=f"one came with {actual}",
                remedy="Set the camera up in the rig so that it sends plain images of one size and format.",
            )
    offset = optional_int(buffer, "image_offset") or 0
    wire_bytes = wire.wire_bytes(expected_format.height_px * expected_format.width_px)
    data = np.frombuffer(buffer.raw_buffer, np.uint8, wire_bytes, offset)
    pixels = memory.view(np.uint16)
    if wire.packing == "two bytes":
        pixels[:] = data.view("<u2")
    else:
        widen(pixels, data, wire)
    return pixels.reshape(expected_format.height_px, expected_format.width_px)


def timestamp_ns(buffer: Any, camera: Any, device: str) -> int:
    """Return the start of the exposure by the camera's clock, ns. Older producers give ticks; `camera` gives their
    frequency. Raises DeviceRefused if the producer gives neither."""
    stamp_ns = optional_int(buffer, "timestamp_ns")
    if stamp_ns is not None:
        return stamp_ns
    ticks, ticks_hz = optional_int(buffer, "timestamp"), optional_int(camera, "timestamp_frequency")
    if ticks is None or not ticks_hz:
        raise DeviceRefused(
            device,
            expected="timestamps from the producer, in nanoseconds or with their frequency",
            happened="it gives none",
            remedy="Set `timestamps: host` to view images of this camera; shots cannot be proven with it.",
        )
    return ticks * 10**9 // ticks_hz

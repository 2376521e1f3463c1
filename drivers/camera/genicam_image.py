"""Image format of a GenICam camera, which is set and read through features.

All GenICam drivers use it, whatever their library.
"""

from __future__ import annotations

import math

from coupole.devices import FrameFormat
from coupole.errors import DeviceRefused
from drivers.camera.genicam_features import Features
from drivers.camera.genicam_settings import GenICamSettings, Region
from drivers.camera.genicam_state import AT_OPENING, State
from drivers.camera.genicam_trigger import set_trigger
from drivers.camera.pixel_formats import FORMATS, PixelFormat, pixels_in_a_group


def set_up(features: Features, settings: GenICamSettings, *, is_triggered: bool) -> dict[str, str]:
    """Bring a camera that was just opened into its state, whatever its former state was. Return the values that
    were read back.

    The order is: the driver's table, the rig's features in their order, the region, the pixel format and, if
    frames are `is_triggered`, the trigger. Raises DeviceRefused, which names the feature that does not take its
    value.
    """
    state = State(features, settings)
    state.apply(AT_OPENING)
    state.neutralise_gains()
    state.use_one_region_and_component()
    features.write_all(settings.features)
    if settings.region is not None:
        _set_region(features, settings.region)
    else:
        state.use_whole_sensor()
    features.write("PixelFormat", settings.pixel_format)
    if is_triggered:
        set_trigger(state, features, settings, by_edges=True)
    state.note(*settings.features, *settings.leave)
    state.note_all()
    return state.held


def _set_region(features: Features, region: Region) -> None:
    """Set the region. Offsets are set to zero first, because offset and size limit each other."""
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
    """Return the camera's present pixel format. Raises DeviceRefused for a format that the driver does not
    support."""
    name = str(features.read_value("PixelFormat"))
    if name not in FORMATS:
        raise DeviceRefused(
            device,
            expected="a Bayer or mono format of 8 to 16 bits",
            happened=f"it sends {name}",
            remedy=f"Choose one of {', '.join(FORMATS)} for `pixel_format` in the rig.",
        )
    return FORMATS[name]


def frame_format(features: Features, device: str, black_dn: int | None) -> FrameFormat:
    """Return the format of the camera's frames. If `black_dn` is None, black is `BlackLevel`. Raises
    DeviceRefused."""
    pixel_type = pixel_format(features, device)
    width_px, height_px = int(features.number("Width")), int(features.number("Height"))
    if width_px * height_px % pixels_in_a_group(pixel_type):
        raise DeviceRefused(
            device,
            expected=f"an image whose pixels fill whole bytes in {pixel_type.name}",
            happened=f"it has {width_px} x {height_px}",
            remedy="Choose another region or pixel format in the rig.",
        )
    if black_dn is None:
        black_dn = round(features.number("BlackLevel")) if features.has("BlackLevel") else 0
    white_dn = (1 << pixel_type.bit_depth) - 1
    return FrameFormat(height_px, width_px, pixel_type.bit_depth, pixel_type.bayer_pattern, black_dn, white_dn)


def readout_us(features: Features, device: str, given_us: int | None) -> int:
    """Return the least time between two frames, us: `given_us`, or otherwise from the camera's readout time or
    highest frame rate."""
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

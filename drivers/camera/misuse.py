"""The error for methods of a camera that are called in the wrong order."""

from __future__ import annotations

from coupole.devices import FrameFormat
from coupole.errors import DeviceRefused


def misuse_error(device: str, expectation: str, observation: str) -> DeviceRefused:
    """The error to raise; `device` is the camera's name in the rig."""
    return DeviceRefused(
        device,
        expected=expectation,
        happened=observation,
        remedy="This is a fault of the program that drives the camera.",
    )


def refuse_while_armed(device: str, *, is_armed: bool) -> None:
    """Raise DeviceRefused for `configure` of an armed camera."""
    if is_armed:
        raise misuse_error(device, "a disarmed camera", "configure() was called while it is armed")


def format_for_arming(device: str, frame_format: FrameFormat | None) -> FrameFormat:
    """Return the format that `configure` has set. Raises DeviceRefused for `arm` before it."""
    if frame_format is None:
        raise misuse_error(device, "configure() before arm()", "no exposure is set")
    return frame_format

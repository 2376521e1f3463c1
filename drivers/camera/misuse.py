"""The error for methods of a camera that are called in a wrong order."""

from __future__ import annotations

from coupole.errors import DeviceRefused


def misuse_error(device: str, expectation: str, observation: str) -> DeviceRefused:
    """The error to raise; `device` is the camera's name in the rig."""
    return DeviceRefused(
        device,
        expected=expectation,
        happened=observation,
        remedy="This is a fault of the program that drives the camera.",
    )

"""Frames of a camera whose features another program has changed: one class for all cameras with features.

`expected_ramp` of `camera_conformance` returns the expected frames. This module describes the effect of each
feature on frames, and the simulated cameras behave accordingly.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import pytest

from coupole.devices import Camera, Frame
from coupole.testing.camera_conformance import (
    EXPOSURE,
    HEIGHT_PX,
    WIDTH_PX,
    CameraWorld,
    expected_ramp,
    take,
)

Left = tuple[tuple[str, Any], ...]
LEFT_BY_SFNC: Mapping[str, Left] = {
    "acquisition ends after one frame": (("AcquisitionMode", "SingleFrame"),),
    "acquisition ends after two frames": (("AcquisitionMode", "MultiFrame"), ("AcquisitionFrameCount", 2)),
    "frame rate is limited": (("AcquisitionFrameRateEnable", True),),
    "exposure lasts as long as the trigger": (("ExposureMode", "TriggerWidth"),),
    "exposure is automatic": (("ExposureAuto", "Continuous"),),
    "gain is automatic": (("GainAuto", "Continuous"),),
    "gain by numbers": (("GainSelector", "DigitalAll"), ("Gain", 12.0), ("GainSelector", "AnalogAll")),
    "exposure 5 ms after the edge": (("TriggerDelay", 5000.0),),
    "early edges are latched": (("TriggerOverlap", "PreviousFrame"),),
    "every second edge triggers": (("TriggerDivider", 2),),
    "the falling edge triggers": (("TriggerActivation", "FallingEdge"),),
    "the line is inverted": (("LineInverter", True),),
    "an edge starts the acquisition": (("TriggerSelector", "AcquisitionStart"), ("TriggerMode", "On")),
    "a part of the sensor": (("Width", 16), ("Height", 8), ("OffsetX", 8), ("OffsetY", 4)),
    "columns are binned": (("BinningHorizontal", 2),),
    "rows are binned": (("BinningVertical", 2),),
    "columns are skipped": (("DecimationHorizontal", 2),),
    "rows are skipped": (("DecimationVertical", 2),),
    "mirrored left to right": (("ReverseX", True),),
    "mirrored top to bottom": (("ReverseY", True),),
    "a test pattern": (("TestPattern", "GreyHorizontalRamp"),),
    "gamma": (("GammaEnable", True), ("Gamma", 0.5)),
    "a look-up table": (("LUTEnable", True),),
    "red is amplified": (("BalanceRatioSelector", "Red"), ("BalanceRatio", 2.0)),
    "blue is amplified": (("BalanceRatioSelector", "Blue"), ("BalanceRatio", 2.0)),
    "another pixel format": (("PixelFormat", "Mono8"),),
}
"""Features and values, in the order in which a program sets them. The key names the effect of these settings on
frames.
"""


class ForeignStateWorld(CameraWorld, Protocol):
    """A camera whose frames show the ramp of `camera_conformance.expected_ramp`."""

    def leave(self, features: Left) -> None:
        """Let another program set these features and disconnect."""
        ...

    def begun_ns(self, frame: Frame) -> int:
        """Return the world time, ns, at which the frame's exposure began, from the camera's clock."""
        ...


def assert_right_frames(world: ForeignStateWorld, camera: Camera) -> None:
    """Three edges expose three frames, each at its edge; a fourth, which comes too early, is counted."""
    frame_format = camera.configure(EXPOSURE)
    assert (frame_format.height_px, frame_format.width_px) == (HEIGHT_PX, WIDTH_PX)
    camera.arm(8)
    edges_ns = world.fire(12_000, 3_000, 12_000)
    frames = take(camera, 3)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.pixels, expected_ramp(number))
    begun_ns = [world.begun_ns(frame) for frame in frames]
    assert begun_ns == pytest.approx([edges_ns[number] for number in (0, 1, 3)], abs=25_000)
    counts = camera.statistics()
    assert (counts.exposed, counts.over_triggers) == (3, 1)


class ForeignStateConformance:
    """The contract of a driver that sets the camera's whole state itself.

    A subclass gives three fixtures: `world`, a `ForeignStateWorld`; `left`, features that another program has set;
    and `all_left`, all such features.
    """

    def test_frames_are_right_whatever_the_camera_was_left_in(self, world: ForeignStateWorld, left: Left) -> None:
        world.leave(left)
        assert_right_frames(world, world.open())

    def test_frames_are_right_if_all_was_left_otherwise(
        self, world: ForeignStateWorld, all_left: Mapping[str, Left]
    ) -> None:
        for left in all_left.values():
            world.leave(left)
        camera = world.open()
        assert_right_frames(world, camera)
        assert camera.identify().settings

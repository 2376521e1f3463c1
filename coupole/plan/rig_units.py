"""Values of a rig that look as if they were in another unit than expected, such as m where mm are expected.

Values that no cell can have are refused. With a clearance of 0.05 mm instead of 50 mm the arm may hit the object.
With a panel of 0.18 lux instead of 180 lux the light on the object is counted a thousand times too low. For values
that are unlikely but possible, preflight gives a warning. The value 0 means "none", where a rig may have it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from coupole.plan.arm_description import ArmDescription
from coupole.plan.led_table import LedTable
from coupole.plan.rig import KeepOut, KeepOutSphere, Rig
from coupole.plan.validation_messages import KeyPath

_LEAST_SPREAD_MM = 5.0
"""Least extent of a dome, if it has more than one LED."""
_HOTTEST_BOARD_C = 150.0
"""Solder and LEDs of a board do not bear a higher temperature, so a higher limit has no effect. A limit in kelvin
would be 273 too high."""


@dataclass(frozen=True)
class Doubt:
    """A value that is impossible (`is_refused`) or improbable, and a sentence about it."""

    at: KeyPath
    message: str
    is_refused: bool


@dataclass(frozen=True)
class _Least:
    """A value that should be 0, or at least as large as in all cells (`possible`) and in nearly all cells
    (`usual`)."""

    at: KeyPath
    value: float
    unit: str
    possible: float
    usual: float
    hint: str = ""
    """Unit of the value in the file, if it differs from `unit`."""
    may_be_zero: bool = False
    of: str = ""
    """Quantity that is judged, in words, if the key has more than one value."""

    def doubts(self) -> Iterator[Doubt]:
        asks = f"is it in {self.hint or self.unit}?"
        if 0 < self.value < self.possible:
            bound = f"{'0 or ' * self.may_be_zero}at least {self.possible:g} {self.unit}"
            yield Doubt(self.at, f"{self.of}expected {bound}, found {self.value:.3g}; {asks}", True)
        elif 0 < self.value < self.usual:
            yield Doubt(self.at, f"{self.of}{self.value:.3g} {self.unit} is unusually little; {asks}", False)


def doubts_of(rig: Rig) -> list[Doubt]:
    """Return all values of a rig that are improbable in their unit."""
    return [*(doubt for least in _leasts(rig) for doubt in least.doubts()), *_too_hot(rig)]


def doubt_of_dome(leds: LedTable) -> list[Doubt]:
    """Return a doubt if all LEDs are at nearly the same place."""
    spread_mm = float(np.ptp(leds.positions_mm, axis=0).max())
    if len(leds.ids) == 1 or spread_mm >= _LEAST_SPREAD_MM:
        return []
    bound = f"expected LEDs at least {_LEAST_SPREAD_MM:g} mm apart"
    return [Doubt(("dome", "leds"), f"{bound}, found {spread_mm:.3g} mm at most; is it in mm?", True)]


def _leasts(rig: Rig) -> Iterator[_Least]:
    for key, clearance_mm in rig.clearances:
        yield _Least(("clearances", key), clearance_mm, "mm", 0.5, 2.0, may_be_zero=True)
    for number, body in enumerate(rig.tool):
        yield _Least(("tool", number, "radius_mm"), body.radius_mm, "mm", 0.5, 5.0)
        from_mm, to_mm = math.hypot(*body.from_mm), math.hypot(*body.to_mm)
        key = "from_mm" if from_mm > to_mm else "to_mm"
        yield _Least(("tool", number, key), max(from_mm, to_mm), "mm", 1.0, 5.0)
    for number, kept_out in enumerate(rig.keep_out):
        yield _Least(("keep_out", number), _volume_mm3(kept_out), "mm3", 1.0, 1000.0, hint="mm")
        if isinstance(kept_out, KeepOutSphere):
            yield _Least(("keep_out", number, "center_mm"), math.hypot(*kept_out.center_mm), "mm", 0.0, 5.0)
    yield _Least(("lens", "focal_length_mm"), rig.lens.focal_length_mm, "mm", 0.5, 2.0)
    yield _Least(("sensor", "pixel_pitch_um"), rig.sensor.pixel_pitch_um, "um", 0.1, 0.5)
    yield _Least(("support", "diameter_mm"), rig.support.diameter_mm, "mm", 3.0, 20.0)
    support_mm = math.hypot(*rig.support.base_from_support.translation_mm)
    yield _Least(("support", "base_from_support"), support_mm, "mm", 3.0, 20.0)
    yield from _leasts_of_arm(rig)
    yield _Least(("dome", "panel_lux"), rig.dome.panel_lux, "lux", 1.0, 10.0, may_be_zero=True)
    yield _Least(("led_limits", "rise_us"), rig.led_limits.rise_us, "us", 0.0, 10.0)
    board = rig.led_limits.board
    yield _Least(("led_limits", "board", "led_power_w"), board.led_power_w, "W", 0.0, 0.05)
    yield _Least(("led_limits", "board", "time_constant_s"), board.time_constant_s, "s", 0.0, 5.0)
    yield _Least(("motion", "acceleration_deg_s2"), rig.motion.acceleration_deg_s2, "deg/s2", 0.0, 10.0)
    yield _Least(("motion", "jerk_deg_s3"), rig.motion.jerk_deg_s3, "deg/s3", 0.0, 100.0)
    camera_mm = math.hypot(*rig.flange_from_camera.translation_mm)
    yield _Least(("flange_from_camera", "translation_mm"), camera_mm, "mm", 0.0, 5.0)


def _leasts_of_arm(rig: Rig) -> Iterator[_Least]:
    """Yield the arm's length along its joints, and its thinnest capsule: both decide what it touches."""
    if not isinstance(rig.arm, ArmDescription):
        return
    origins_mm = [joint.origin_mm for joint in rig.arm.joints]
    length_mm = sum(math.hypot(*origin_mm) for origin_mm in origins_mm)
    yield _Least(("arm",), length_mm, "mm", 20.0, 100.0, of="the arm's length along its joints: ")
    thinnest_mm = min(capsule.radius_mm for link in rig.arm.links for capsule in link.capsules)
    yield _Least(("arm",), thinnest_mm, "mm", 0.5, 5.0, of="the thinnest body of its links: ")


def _too_hot(rig: Rig) -> Iterator[Doubt]:
    limit_c = rig.led_limits.board.limit_c
    if limit_c > _HOTTEST_BOARD_C:
        message = f"expected at most {_HOTTEST_BOARD_C:g} C, found {limit_c:.3g}; is it in C?"
        yield Doubt(("led_limits", "board", "limit_c"), message, True)


def _volume_mm3(kept_out: KeepOut) -> float:
    if isinstance(kept_out, KeepOutSphere):
        return 4.0 / 3.0 * math.pi * kept_out.radius_mm**3
    return math.prod(high - low for low, high in zip(kept_out.min_mm, kept_out.max_mm, strict=True))

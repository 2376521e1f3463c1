"""Devices whose calls are noted (`coupole.bounded`), so that one that never returns is noticed and left behind.

The limit of a call is derived from its work. Drivers have their own time-outs, which are shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from coupole.bounded import under_way
from coupole.kinematics import move_duration_s
from coupole.motion.itinerary import arm_of
from coupole.plan.rig import Rig

NAMES = {"ledbox": "led box", "camera": "camera", "robot": "robot"}
"""Names of the devices in errors."""
_DEADLINE_SHARE = 10.0
"""`coupole.clock.Deadline` waits this many times as long by the machine's clock, if the rig's clock stands."""
_STEP_BYTES, _SLOWEST_BYTES_S = 16, 480.0
"""Size of a step of a table; speed of a serial line of 4800 baud."""

_WORK_S: Mapping[str, Callable[..., float]] = {
    "next_frame": lambda timeout_s: _DEADLINE_SHARE * timeout_s,
    "flash": lambda led, on_us: on_us * 1e-6,
    "load": lambda table: len(table) * _STEP_BYTES / _SLOWEST_BYTES_S,
}
_SETTLES = 2.0
"""Times of a motion for which drivers wait at most."""


class NotedDevice:
    """A device, but for the notes."""

    def __init__(self, device: Any, kind: str, rig: Rig) -> None:
        self._device, self._kind, self._rig = device, kind, rig
        self._speed = 1.0

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._device, name)
        if not callable(value):
            return value
        of, work_s = NAMES[self._kind], _WORK_S.get(name)
        if name == "wait_settled":
            work_s = self._longest_motion_s

        def call(*arguments: Any, **keywords: Any) -> Any:
            with under_way(of, name, work_s(*arguments, **keywords) if work_s else 0.0):
                return value(*arguments, **keywords)

        self.__dict__[name] = call  # found at once the next time
        return call

    def move_to(self, joints_deg: Any, speed: float = 1.0) -> None:
        self._speed = speed
        with under_way(NAMES[self._kind], "move_to"):
            self._device.move_to(joints_deg, speed)

    def _longest_motion_s(self) -> float:
        """Return the time of a motion from one end of the axes' ranges to the other, at the speed of the last
        motion."""
        arm = arm_of(self._rig)
        lowest_deg, highest_deg = zip(*arm.limits_deg, strict=True)
        return _SETTLES * move_duration_s(arm, lowest_deg, highest_deg) / max(self._speed, 1e-3)

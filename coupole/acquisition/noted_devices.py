"""Devices whose calls are noted (`coupole.bounded`), so that a call that never returns is noticed and left behind.

The time limit of a call is derived from its work. Drivers have their own time-outs, which are shorter. After the
cell was made safe, calls that light a lamp or move the arm are refused. The reason is that a thread which was left
behind may go on when its call returns after all.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from coupole.bounded import under_way
from coupole.errors import DeviceRefused
from coupole.kinematics import move_duration_s
from coupole.motion.itinerary import arm_of
from coupole.plan.rig import Rig

NAMES = {"ledbox": "led box", "camera": "camera", "robot": "robot"}
"""Names of the devices in errors."""
_DEADLINE_SHARE = 10.0
"""`coupole.clock.Deadline` waits this many times as long by the machine's clock if the rig's clock stands
still."""
_STEP_BYTES, _SLOWEST_BYTES_S = 16, 480.0
"""Size of a step of a table; speed of a serial line of 4800 baud."""

_WORK_S: Mapping[str, Callable[..., float]] = {
    "next_frame": lambda timeout_s: _DEADLINE_SHARE * timeout_s,
    "flash": lambda led, on_us: on_us * 1e-6,
    "load": lambda table: len(table) * _STEP_BYTES / _SLOWEST_BYTES_S,
}
_LIGHTS_OR_MOVES = frozenset({"flash", "move_to", "start"})
_SETTLES = 2.0
"""Drivers wait at most this many times the duration of a motion."""


class NotedDevice:
    """A device whose calls are noted. In all else it behaves like the device itself."""

    def __init__(self, device: Any, kind: str, rig: Rig, made_safe: threading.Event) -> None:
        """`made_safe` is set before the lights are switched off and the arm is stopped at the end."""
        self._device, self._kind, self._rig, self._made_safe = device, kind, rig, made_safe
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
                if name in _LIGHTS_OR_MOVES:
                    self._refuse_after_the_end(name)
                return value(*arguments, **keywords)

        self.__dict__[name] = call  # found at once the next time
        return call

    def move_to(self, joints_deg: Any, speed: float = 1.0) -> None:
        self._speed = speed
        with under_way(NAMES[self._kind], "move_to"):
            self._refuse_after_the_end("move_to")
            self._device.move_to(joints_deg, speed)

    def panel(self, panel: int, on: bool) -> None:
        with under_way(NAMES[self._kind], "panel"):
            if on:
                self._refuse_after_the_end("panel")
            self._device.panel(panel, on)

    def _refuse_after_the_end(self, name: str) -> None:
        """Raise DeviceRefused once the cell was made safe."""
        if self._made_safe.is_set():
            raise DeviceRefused(
                NAMES[self._kind],
                expected="no light and no motion after the cell was made safe",
                happened=f"`{name}` was called",
                remedy="The session has ended; resume the run.",
            )

    def _longest_motion_s(self) -> float:
        """Return the time of a motion from one end of the axes' ranges to the other, at the speed of the last
        motion."""
        arm = arm_of(self._rig)
        lowest_deg, highest_deg = zip(*arm.limits_deg, strict=True)
        return _SETTLES * move_duration_s(arm, lowest_deg, highest_deg) / max(self._speed, 1e-3)

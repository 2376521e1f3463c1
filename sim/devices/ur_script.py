"""Reacts to registers as the program does that ur-rtde uploads (modelled on ur-rtde 1.6).

The client writes a command number to input_int_register_0 and its arguments to others; the program answers in
output_int_register_0: 1 ready, 2 done. Then the client writes 0, and the program is ready again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

from sim.devices.ur_arm import Six
from sim.devices.ur_rtde_wire import Value

_NONE, _MOVEJ, _MOVEL, _STOPJ, _SET_WATCHDOG, _GET_TCP_OFFSET, _END = 0, 1, 3, 34, 35, 40, 255
_READY, _DONE = 1, 2
_ASYNC_RUNNING = 0x8000
_FULL_TURN_RAD = 2.0 * math.pi
"""Joint limit. It is also larger than any coordinate of the tool in m or rad."""


class Arm(Protocol):
    """Motions of the arm that the program starts."""

    @property
    def moving(self) -> bool: ...
    def start_movej(self, target_deg: Six, speed_deg_s: float, acceleration_deg_s2: float) -> None: ...
    def start_movel(self, tool_pose_m_rad: Six, speed_m_s: float, acceleration_m_s2: float) -> None: ...
    def start_stopj(self, deceleration_deg_s2: float) -> None: ...


class ControlScript:
    """One run of the program; call `cycle` once per controller cycle."""

    def __init__(self, arm: Arm, tcp_offset_m_rad: Six) -> None:
        self.ended = ""
        """Reason why the program ended by itself; empty while it runs."""
        self.watchdog_s: float | None = None
        """The controller ends the program after this time without a write to input_int_register_0; None: never."""
        self.outputs: dict[str, Value] = {}
        self._arm, self._tcp_offset = arm, tcp_offset_m_rad
        self._executing = False
        self._async_running = False
        self._async_count = self._async_operation = 0
        self._signal_async(running=False)

    def cycle(self, inputs: Mapping[str, Value]) -> None:
        """Process the registers once; `inputs` holds all registers ever written."""
        if self._async_running and not self._arm.moving:
            self._signal_async(running=False)
        command = int(_number(inputs, "input_int_register_0"))
        if command == _NONE:
            self._executing = False
            self.outputs["output_int_register_0"] = _READY
        elif not self._executing:
            self._executing = True
            self._process(command, inputs)
        elif self._async_running or not self._arm.moving:
            self.outputs["output_int_register_0"] = _DONE  # a synchronous motion is done when it has ended

    def _process(self, command: int, inputs: Mapping[str, Value]) -> None:
        numbers = [_number(inputs, f"input_double_register_{i}") for i in range(8)]
        asynchronous = _number(inputs, "input_int_register_1") == 1
        if not _possible(command, numbers):
            self.ended = f"runtime error: command {command} with {numbers}"
        elif command == _MOVEJ:
            self._arm.start_movej(
                tuple(map(math.degrees, numbers[:6])), math.degrees(numbers[6]), math.degrees(numbers[7])
            )
            self._signal_async(running=asynchronous)
        elif command == _MOVEL:
            self._arm.start_movel(tuple(numbers[:6]), numbers[6], numbers[7])
            self._signal_async(running=asynchronous)
        elif command == _STOPJ:
            self._arm.start_stopj(math.degrees(numbers[0]))
            self._signal_async(running=asynchronous)
        elif command == _SET_WATCHDOG:
            self.watchdog_s = 1.0 / numbers[0]
        elif command == _GET_TCP_OFFSET:
            for i, number in enumerate(self._tcp_offset):
                self.outputs[f"output_double_register_{i}"] = number
        elif command == _END:
            self.ended = "the client ended it"
        else:
            self.ended = f"this stand-in does not know command {command}"

    def _signal_async(self, *, running: bool) -> None:
        """Bits 24 to 30 count operations, bits 16 to 22 writes; bit 15 is set while an operation runs."""
        self._async_running = running
        self._async_count = (self._async_count + 1) % 128
        self._async_operation = (self._async_operation + running) % 128
        register = self._async_operation << 24 | self._async_count << 16 | _ASYNC_RUNNING * running
        self.outputs["output_int_register_2"] = register


def _possible(command: int, numbers: Sequence[float]) -> bool:
    """False for arguments with which URScript's functions end the program."""
    if not all(map(math.isfinite, numbers)):
        return False
    if command in {_MOVEJ, _MOVEL}:
        return max(map(abs, numbers[:6])) <= _FULL_TURN_RAD and min(numbers[6:8]) > 0
    return numbers[0] > 0 if command in {_STOPJ, _SET_WATCHDOG} else True


def _number(inputs: Mapping[str, Value], name: str) -> float:
    value = inputs.get(name, 0.0)
    assert not isinstance(value, tuple)  # registers hold one number each
    return value

"""One open xiAPI camera: parameters by name, images into the driver's memory.

Calls from all threads are serialised in the order of request, because the header does not say that two threads may
use a camera's handle at once. A thread that waits for an image lets others call in between.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any

from coupole.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.camera.xiapi.library import (
    ABSENT,
    GONE,
    LOCKED,
    OK,
    OPEN_BY_SERIAL,
    TIMEOUT,
    Image,
    code_name,
    load,
)
from drivers.fair_lock import FairLock

Value = int | float | str
_TEXT_BYTES = 256


class XiDevice:
    """Each method may raise DeviceLost, or DeviceRefused with xiAPI's error name."""

    def __init__(self, library: str, serial: str, name: str) -> None:
        self.name = name
        """The camera's name in messages."""
        self._library = load(library, name)
        self._lock = FairLock()
        self._handle = ctypes.c_void_p()
        self.acquiring = False
        self._open(serial)

    def _open(self, serial: str) -> None:
        camera_count = ctypes.c_uint32()
        self._check(self._library.xiGetNumberDevices(camera_count), "a list of the XIMEA cameras")
        if camera_count.value == 0 or (camera_count.value > 1 and not serial):
            raise DeviceLost(
                self.name,
                expected=f"XIMEA camera {serial}" if serial else "exactly one XIMEA camera",
                happened=f"{camera_count.value} are connected",
                remedy="Give the camera's `serial` in the rig."
                if camera_count.value
                else "Check cable, power, driver.",
            )
        if serial:
            code = self._library.xiOpenDeviceBy(OPEN_BY_SERIAL, serial.encode(), self._handle)
        else:
            code = self._library.xiOpenDevice(0, self._handle)
        if code == LOCKED:
            raise DeviceRefused(
                self.name,
                expected="a free camera",
                happened=f"it is in use ({code_name(code)})",
                remedy="Close the other program.",
            )
        self._check(code, f"XIMEA camera {serial} to open" if serial else "the XIMEA camera to open")

    def _check(self, code: int, expectation: str) -> None:
        if code == OK:
            return
        kind: type[DeviceError] = DeviceLost if code in GONE else DeviceRefused
        raise kind(
            self.name,
            expected=expectation,
            happened=f"xiAPI answered {code_name(code)} ({code})",
            remedy="Check cable and power, then resume the run."
            if code in GONE
            else "Check the camera's settings in the rig against its manual.",
        )

    # -- parameters ---------------------------------------------------------------------------------------

    def _get_parameter(self, parameter: str, value: Any) -> int:
        with self._lock:
            get = self._library.xiGetParamInt if isinstance(value, ctypes.c_int) else self._library.xiGetParamFloat
            code: int = get(self._handle, parameter.encode(), value)
        return code

    def has(self, parameter: str) -> bool:
        return self._get_parameter(parameter, ctypes.c_int()) not in ABSENT

    def whole(self, parameter: str) -> int:
        value = ctypes.c_int()
        self._check(self._get_parameter(parameter, value), f"a value of `{parameter}`")
        return value.value

    def number(self, parameter: str) -> float:
        value = ctypes.c_float()
        self._check(self._get_parameter(parameter, value), f"a value of `{parameter}`")
        return value.value

    def text(self, parameter: str) -> str:
        value = ctypes.create_string_buffer(_TEXT_BYTES)
        with self._lock:
            code = self._library.xiGetParamString(self._handle, parameter.encode(), value, _TEXT_BYTES)
        self._check(code, f"a value of `{parameter}`")
        return value.value.decode(errors="replace")

    def set(self, parameter: str, value: Value) -> None:
        """Set a parameter after checking the range that the camera reports. Nothing is clipped."""
        if not isinstance(value, str):
            self._check_range(parameter, value)
        name = parameter.encode()
        with self._lock:
            if isinstance(value, str):
                raw = value.encode()
                code = self._library.xiSetParamString(self._handle, name, raw, len(raw))
            elif isinstance(value, int):
                code = self._library.xiSetParamInt(self._handle, name, value)
            else:
                code = self._library.xiSetParamFloat(self._handle, name, value)
        self._check(code, f"`{parameter}` to take {value}")

    def set_if_present(self, parameter: str, value: Value) -> None:
        """Set a parameter that only some models have, if this model has it."""
        if self.has(parameter):
            self.set(parameter, value)

    def bounds(self, parameter: str) -> tuple[float, float]:
        """Smallest and largest value; infinite if the camera reports none."""
        ends = []
        for info, unknown in ((":min", -math.inf), (":max", math.inf)):
            value = ctypes.c_float()
            code = self._get_parameter(parameter + info, value)
            if code not in ABSENT:
                self._check(code, f"a value of `{parameter}{info}`")
            ends.append(unknown if code in ABSENT else value.value)
        return ends[0], ends[1]

    def _check_range(self, parameter: str, value: float) -> None:
        low, high = self.bounds(parameter)
        # the reported limits are 32-bit floats: a value at a limit may exceed it by rounding
        slack = 1e-6 * max(abs(low), abs(high)) if math.isfinite(low + high) else 0.0
        if not low - slack <= value <= high + slack:
            raise DeviceRefused(
                self.name,
                expected=f"`{parameter}` from {low:g} to {high:g}",
                happened=f"{value:g} was asked for",
                remedy="Change it in plan or rig.",
            )

    # -- acquisition --------------------------------------------------------------------------------------

    def start(self) -> None:
        with self._lock:
            self._check(self._library.xiStartAcquisition(self._handle), "the acquisition to start")
            self.acquiring = True

    def stop(self) -> None:
        """Stop the acquisition. Does nothing if none runs."""
        with self._lock:
            if self.acquiring:
                self.acquiring = False
                self._check(self._library.xiStopAcquisition(self._handle), "the acquisition to stop")

    def image(self, address: int, size: int, timeout_s: float) -> Image | None:
        """Return the oldest image, with its pixels at `address`. None if no image came in time, or if no
        acquisition runs."""
        image = Image(size=ctypes.sizeof(Image), bp=address, bp_size=size)
        with self._lock:
            if not self.acquiring:
                return None
            code = self._library.xiGetImage(self._handle, max(1, math.ceil(timeout_s * 1000)), image)
        if code == TIMEOUT:
            return None
        self._check(code, "an image")
        if image.bp != address:
            raise DeviceRefused(
                self.name,
                expected="the image in the buffer that was given",
                happened="xiAPI put it elsewhere",
                remedy="This version of libm3api does not honour the safe buffer policy: install another.",
            )
        return image

    def close(self) -> None:
        with self._lock:
            handle, self._handle = self._handle, ctypes.c_void_p()
            if handle:
                self._library.xiCloseDevice(handle)

"""GenICam features of an open camera, by name; types and ranges are checked before anything is written."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping
from typing import Any, NoReturn

from coupole.errors import DeviceRefused
from drivers.camera.aravis.library import call, is_a
from drivers.camera.genicam_features import alike
from drivers.camera.genicam_settings import Value

_KINDS = ("command", "enumeration", "boolean", "integer", "float", "string")
_READ_ONLY = 0
"""ArvGcAccessMode (arvgcenums.h)."""


class Features:
    """Reads and writes features of one device; `device` is its name in the rig."""

    def __init__(self, library: Any, handle: int, device: str) -> None:
        self._library, self._handle, self._device = library, handle, device
        self._lock = threading.RLock()  # libaravis evaluates feature formulas without a lock

    def has(self, name: str) -> bool:
        """True if the camera has the feature and the feature can be used now."""
        with self._lock:
            if not self._library.arv_device_get_feature(self._handle, name.encode()):
                return False
            return bool(self._call("is_feature_available", name))

    def first_of(self, *names: str) -> str | None:
        """Return the first of these features that the camera has."""
        return next((name for name in names if self.has(name)), None)

    def read_value(self, name: str) -> Value:
        """Raises DeviceRefused if the camera has no such feature, or the feature has no value."""
        with self._lock:
            match self._kind(name):
                case "enumeration" | "string":
                    text = self._call("get_string_feature_value", name)
                    return (text or b"").decode(errors="replace")
                case "boolean":
                    return bool(self._call("get_boolean_feature_value", name))
                case "integer":
                    return int(self._call("get_integer_feature_value", name))
                case "float":
                    return float(self._call("get_float_feature_value", name))
                case kind:
                    self._refuse(f"`{name}` to hold a value", f"it is a {kind}")

    def number(self, name: str) -> float:
        """The value of an integer or float feature."""
        value = self.read_value(name)
        if isinstance(value, str):
            self._refuse(f"a number in `{name}`", f"it holds {value!r}")
        return value

    def write(self, name: str, value: Value) -> None:
        """Set a feature and read it back.

        Raises DeviceRefused if there is no such feature, the value has the wrong type or is out of range, or the
        camera then holds another value.
        """
        with self._lock:
            kind = self._kind(name)
            if self._library.arv_device_get_feature_access_mode(self._handle, name.encode()) == _READ_ONLY:
                self._refuse("a feature that can be set", f"`{name}` can only be read")
            getattr(self, f"_write_{kind}")(name, value)
            if kind == "command":
                return
            read_back = self.read_value(name)
        if not alike(read_back, value):
            self._refuse(f"`{name}` to hold {value!r} once it is set", f"it holds {read_back!r}")

    def write_all(self, values: Mapping[str, Value]) -> None:
        """Set features in their order."""
        for name, value in values.items():
            self.write(name, value)

    def execute(self, name: str) -> None:
        """Run a command."""
        with self._lock:
            self._call("execute_command", name)

    def bounds(self, name: str) -> tuple[float, float]:
        """Least and greatest value of an integer or float feature."""
        kind = self._kind(name)
        number = ctypes.c_int64 if kind == "integer" else ctypes.c_double
        least, most = number(), number()
        with self._lock:
            self._call(f"get_{kind}_feature_bounds", name, ctypes.byref(least), ctypes.byref(most))
        return least.value, most.value

    def largest(self, name: str) -> int:
        """Greatest value of an integer feature, in its steps."""
        with self._lock:
            least, most = (int(end) for end in self.bounds(name))
            return most - (most - least) % max(1, int(self._call("get_integer_feature_increment", name)))

    def entries(self, name: str) -> list[str]:
        """Names of the enumeration's entries that are available now."""
        count = ctypes.c_uint()
        with self._lock:
            names = self._call("dup_available_enumeration_feature_values_as_strings", name, ctypes.byref(count))
        try:
            return [names[i].decode() for i in range(count.value)]
        finally:
            self._library.g_free(ctypes.cast(names, ctypes.c_void_p))

    # -- by type ------------------------------------------------------------------------------------------

    def _kind(self, name: str) -> str:
        node = self._library.arv_device_get_feature(self._handle, name.encode())
        if not node:
            self._refuse(f"a camera with the feature `{name}`", "it has none of that name")
        for kind in _KINDS:
            if is_a(self._library, node, f"arv_gc_{kind}"):
                return kind
        self._refuse(f"a feature `{name}` with a value", "it is a category or a register")

    def _write_command(self, name: str, value: Value) -> None:
        if value is not True:
            self._refuse(f"`true` for the command `{name}`", f"{value!r} was given")
        self.execute(name)

    def _write_enumeration(self, name: str, value: Value) -> None:
        entries = self.entries(name)
        if value not in entries:
            self._refuse(f"one of {', '.join(entries)} for `{name}`", f"{value!r} was given")
        self._call("set_string_feature_value", name, str(value).encode())

    def _write_string(self, name: str, value: Value) -> None:
        if not isinstance(value, str):
            self._refuse(f"a text for `{name}`", f"{value!r} was given")
        self._call("set_string_feature_value", name, value.encode())

    def _write_boolean(self, name: str, value: Value) -> None:
        if not isinstance(value, bool):
            self._refuse(f"true or false for `{name}`", f"{value!r} was given")
        self._call("set_boolean_feature_value", name, int(value))

    def _write_integer(self, name: str, value: Value) -> None:
        if isinstance(value, bool) or not isinstance(value, int):
            self._refuse(f"a whole number for `{name}`", f"{value!r} was given")
        self._check_range(name, value)
        least, step = int(self.bounds(name)[0]), int(self._call("get_integer_feature_increment", name))
        if step > 1 and (value - least) % step:
            self._refuse(f"{least} plus a multiple of {step} for `{name}`", f"{value} was given")
        self._call("set_integer_feature_value", name, value)

    def _write_float(self, name: str, value: Value) -> None:
        if isinstance(value, bool | str):
            self._refuse(f"a number for `{name}`", f"{value!r} was given")
        self._check_range(name, value)
        self._call("set_float_feature_value", name, float(value))

    def _check_range(self, name: str, value: float) -> None:
        least, most = self.bounds(name)
        if not least <= value <= most:
            self._refuse(f"{least:.10g} to {most:.10g} for `{name}`", f"{value:.10g} was given")

    def _call(self, function: str, name: str, *arguments: Any) -> Any:
        whole = getattr(self._library, f"arv_device_{function}")
        return call(
            self._device, f"an answer about the feature `{name}`", whole, self._handle, name.encode(), *arguments
        )

    def _refuse(self, expectation: str, observation: str) -> NoReturn:
        raise DeviceRefused(
            self._device,
            expected=expectation,
            happened=observation,
            remedy="Correct the camera's settings in the rig (`arv-tool-0.8 features` lists what a camera has).",
        )

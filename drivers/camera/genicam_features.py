"""Access to a camera's GenICam features, for the functions that the GenICam drivers share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from drivers.camera.genicam_settings import Value

_READBACK_TOLERANCE = 0.01
"""Relative tolerance of values that are read back. Cameras round values: an exposure to the line time, a gain to
the converter's steps."""


class Features(Protocol):
    """Features of an open camera, by name; each driver's own class documents its errors."""

    def has(self, name: str) -> bool: ...

    def first_of(self, *names: str) -> str | None: ...

    def read_value(self, name: str) -> Value: ...

    def number(self, name: str) -> float: ...

    def bounds(self, name: str) -> tuple[float, float]: ...

    def largest(self, name: str) -> int: ...

    def entries(self, name: str) -> list[str]: ...

    def write(self, name: str, value: Value) -> None: ...

    def write_all(self, values: Mapping[str, Value]) -> None: ...


def alike(readback: Value, setting: Value) -> bool:
    """True if `readback` is the value that was set, within the rounding of cameras."""
    if isinstance(readback, bool) != isinstance(setting, bool):
        return False
    if isinstance(readback, float) and not isinstance(setting, str):
        return math.isclose(readback, setting, rel_tol=_READBACK_TOLERANCE, abs_tol=1e-9)
    return readback == setting

"""What the drivers of GenICam cameras ask of a camera's features, by whichever library they reach them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from drivers.camera.genicam_settings import Value

_READBACK_TOLERANCE = 0.01
"""Cameras round: an exposure to their line time, a gain to their converter's steps."""


class Features(Protocol):
    """Of an opened camera, by name; see the drivers' own for what they raise."""

    def has(self, name: str) -> bool: ...

    def first_of(self, *names: str) -> str | None: ...

    def read(self, name: str) -> Value: ...

    def number(self, name: str) -> float: ...

    def bounds(self, name: str) -> tuple[float, float]: ...

    def write(self, name: str, value: Value) -> None: ...

    def write_all(self, values: Mapping[str, Value]) -> None: ...


def alike(held: Value, wanted: Value) -> bool:
    """True if a feature that was set holds what was wanted, numbers rounded as cameras do."""
    if isinstance(held, float) and not isinstance(wanted, str):
        return math.isclose(held, wanted, rel_tol=_READBACK_TOLERANCE, abs_tol=1e-9)
    return held == wanted

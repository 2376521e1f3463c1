"""GenICam features in a camera's node map, by name; types and ranges are checked before anything is written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn

from coupole.errors import DeviceLost, DeviceRefused
from drivers.camera.genicam_features import alike
from drivers.camera.genicam_settings import Value

_TYPES: dict[str, tuple[type, ...]] = {
    "IInteger": (int,),
    "IFloat": (int, float),
    "IBoolean": (bool,),
    "IEnumeration": (str,),
    "IString": (str,),
    "ICommand": (bool,),
}
"""Python's types for GenApi's interfaces."""


class Features:
    """Reads and writes the features of one camera; `device` is its name in the rig.

    Each method raises DeviceRefused if the camera lacks the feature or rejects the access, DeviceLost if it does
    not answer.
    """

    def __init__(self, node_map: Any, device: str) -> None:
        import genicam.genapi
        import genicam.gentl

        self._genapi = genicam.genapi
        gentl = genicam.gentl
        self._errors = (genicam.genapi.GenericException, gentl.GenericException)
        self._silence = (gentl.IoException, gentl.TimeoutException, gentl.InvalidHandleException)
        self._nodes, self._device = node_map, device

    def has(self, name: str) -> bool:
        """True if the camera has the feature and the feature can be used now."""
        try:
            return bool(self._nodes.has_node(name) and self._genapi.is_available(self._nodes.get_node(name).node))
        except self._errors as error:
            self._raise_failure(f"to learn whether it has `{name}`", error)

    def expect_answer(self) -> None:
        """Query the camera itself, not the cache. Raises DeviceLost."""
        try:
            self._node("Width").get_value(ignore_cache=True)
        except self._errors as error:
            self._raise_lost("the camera to answer", error)

    def first_of(self, *names: str) -> str | None:
        """Return the first of these features that the camera has."""
        return next((name for name in names if self.has(name)), None)

    def read_value(self, name: str) -> Value:
        node = self._node(name)
        if self._kind(node) not in _TYPES or self._kind(node) == "ICommand":
            self._refuse(f"`{name}` to hold a value", f"it is a {self._kind(node)[1:].lower()}")
        try:
            value: Value = node.value
        except self._errors as error:
            self._raise_failure(f"a value of `{name}`", error)
        return value

    def number(self, name: str) -> float:
        """The value of an integer or float feature."""
        value = self.read_value(name)
        if isinstance(value, str):
            self._refuse(f"a number in `{name}`", f"it holds {value!r}")
        return value

    def bounds(self, name: str) -> tuple[float, float]:
        """Least and greatest value of an integer or float feature."""
        node = self._node(name)
        if self._kind(node) not in {"IInteger", "IFloat"}:
            self._refuse(f"a number in `{name}`", f"it is a {self._kind(node)[1:].lower()}")
        try:
            return float(node.min), float(node.max)
        except self._errors as error:
            self._raise_failure(f"the bounds of `{name}`", error)

    def largest(self, name: str) -> int:
        """Greatest value of an integer feature, in its steps."""
        least, most = (int(end) for end in self.bounds(name))
        return most - (most - least) % max(1, int(self._node(name).inc))

    def entries(self, name: str) -> list[str]:
        """Names of the enumeration's entries that are available now."""
        node = self._node(name)
        if self._kind(node) != "IEnumeration":
            self._refuse(f"`{name}` to be an enumeration", f"it is a {self._kind(node)[1:].lower()}")
        try:
            return [str(entry.symbolic) for entry in node.entries if self._genapi.is_available(entry.node)]
        except self._errors as error:
            self._raise_failure(f"the entries of `{name}`", error)

    def write(self, name: str, value: Value) -> None:
        """Set a feature and read it back; `True` runs a command."""
        node = self._node(name)
        try:
            self._check(name, node, value)
            if self._kind(node) == "ICommand":
                node.execute()
                return
            node.value = value
            read_back = node.value
        except self._errors as error:
            self._raise_failure(f"`{name}` to take {value!r}", error)
        if not alike(read_back, value):
            self._refuse(f"`{name}` to hold {value!r} once it is set", f"it holds {read_back!r}")

    def write_all(self, values: Mapping[str, Value]) -> None:
        """Set features in their order."""
        for name, value in values.items():
            self.write(name, value)

    def _node(self, name: str) -> Any:
        if not self._nodes.has_node(name):
            self._refuse(f"a camera with the feature `{name}`", "it has none of that name")
        return self._nodes.get_node(name)

    def _kind(self, node: Any) -> str:
        return type(node).__name__

    def _check(self, name: str, node: Any, value: Value) -> None:
        kind = self._kind(node)
        types = _TYPES.get(kind)
        if types is None:
            self._refuse(f"a feature `{name}` that can be set", f"it is a {kind[1:].lower()}")
        right = isinstance(value, types) and (bool in types or not isinstance(value, bool))
        if not right or (kind == "ICommand" and value is not True):
            self._refuse(f"a {kind[1:].lower()} for `{name}`", f"{value!r} was given")
        if kind == "IEnumeration" and value not in node.symbolics:
            self._refuse(f"one of {', '.join(node.symbolics)} for `{name}`", f"{value!r} was given")
        if kind in {"IInteger", "IFloat"}:
            self._check_range(name, node, float(value))
        if not self._genapi.is_writable(node.node):
            self._refuse(f"`{name}` to be writable now", "the camera says that it cannot be set")

    def _check_range(self, name: str, node: Any, value: float) -> None:
        if not node.min <= value <= node.max:
            self._refuse(f"{node.min:.10g} to {node.max:.10g} for `{name}`", f"{value:.10g} was given")
        if self._kind(node) == "IInteger" and node.inc > 1 and (value - node.min) % node.inc:
            self._refuse(f"{node.min} plus a multiple of {node.inc} for `{name}`", f"{value:.10g} was given")

    def _raise_failure(self, expectation: str, error: Exception) -> NoReturn:
        """Raise DeviceLost if the camera does not answer, DeviceRefused for any other error."""
        if isinstance(error, self._silence):
            self._raise_lost(expectation, error)
        self._refuse(expectation, str(error))

    def _raise_lost(self, expectation: str, error: Exception) -> NoReturn:
        raise DeviceLost(
            self._device,
            expected=expectation,
            happened=str(error),
            remedy="Check cable and power, then resume the run.",
        ) from error

    def _refuse(self, expectation: str, observation: str) -> NoReturn:
        raise DeviceRefused(
            self._device,
            expected=expectation,
            happened=observation,
            remedy="Correct the camera's settings in the rig; the maker's viewer shows its features.",
        )

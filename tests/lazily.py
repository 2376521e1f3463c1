"""Libraries that few tests want and that take a second to import: every worker imports every test's module."""

from __future__ import annotations

import importlib
from typing import Any


class lazily:  # noqa: N801  # reads as the import that it stands for
    """`colour: Any = lazily("colour")` is the module from the first time on that something of it is asked for.

    Names with an underscore are not of it: pytest asks everything in a module of tests for some of them."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_"):
            raise AttributeError(attribute)
        return getattr(importlib.import_module(self._name), attribute)

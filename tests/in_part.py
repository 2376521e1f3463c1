"""Parameters of which the suite takes a few, and `--full` all."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def in_part(values: Iterable[Any], *taken: Any) -> list[Any]:
    """Each of these values (tuples are several arguments), marked `full` unless it is `taken`."""

    def parameter(value: Any) -> Any:
        arguments = value if isinstance(value, tuple) else (value,)
        return pytest.param(*arguments, marks=() if value in taken else pytest.mark.full)

    return [parameter(value) for value in values]

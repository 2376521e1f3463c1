"""The JSON schemas that editors get: valid, and with words for every key."""

from __future__ import annotations

import json
from typing import Any

import cells
import pytest


@pytest.mark.parametrize("what", ["plan", "rig"])
def test_every_key_is_described(what: str) -> None:
    ended = cells.here("schema", what)
    schema: dict[str, Any] = json.loads(ended.out)
    keys = {
        f"{name}.{key}": described
        for name, model in {what: schema, **schema["$defs"]}.items()
        for key, described in model.get("properties", {}).items()
    }
    assert len(keys) > 60
    assert [key for key, described in keys.items() if not described.get("description", "").endswith(".")] == []

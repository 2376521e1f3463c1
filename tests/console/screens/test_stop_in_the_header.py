"""When the header's Stop can be pressed, and what the header says of light."""

from __future__ import annotations

from typing import Any

import pytest

from coupole.console.routes.messages import StateNow


@pytest.mark.parametrize(
    ("so", "stops", "dark"),
    [
        ({}, False, True),
        ({"state": "halted"}, False, True),
        ({"state": "stopping", "run": "one"}, True, False),
        ({"state": "concluding"}, True, True),
        ({"state": "silent", "run": "one"}, True, False),
        ({"lent_to": "Ada: live"}, True, False),
        ({"devices": {"camera": {}}}, True, False),
    ],
)
def test_stop_can_be_pressed_whenever_something_may_move_or_light(
    so: dict[str, Any], stops: bool, dark: bool
) -> None:
    from coupole.console.screens.frame import can_be_stopped, light_words

    usual: dict[str, Any] = {"state": "idle", "lent_to": "", "devices": {}, "queue": [], "run": None, "object": ""}
    now = StateNow.model_construct(**{**usual, "dose_before": 0.0, "dose": 0.0, "dose_budget": None, **so})
    assert can_be_stopped(now) is stops
    assert (light_words(now) == "no light is given") is dark

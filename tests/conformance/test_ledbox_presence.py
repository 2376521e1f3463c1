"""The enabling switch on an input of the LED box: held, released, and boxes that have none or tell nonsense."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from ledbox_world import ledbox_world, opened, text_world

from coupole.errors import DeviceError


@pytest.mark.parametrize(("switch", "held", "told"), [("held", True, "held"), ("released", False, "released")])
def test_a_switch_is_told_as_it_is(tmp_path: Path, switch: str, held: bool, told: str) -> None:
    with ledbox_world(tmp_path, enabling_switch=switch) as world, opened(world) as box:
        assert box.presence() is held
        assert box.self_test()["enabling switch"] == told


def test_a_switch_that_is_pressed_and_let_go_is_followed(tmp_path: Path) -> None:
    with ledbox_world(tmp_path, enabling_switch="released") as world, opened(world) as box:
        seen = [box.presence()]
        for now in ("held", "released"):
            world.do(lambda now=now: setattr(world.box, "enabling_switch", now))
            seen.append(box.presence())
    assert seen == [False, True, False]


@pytest.mark.parametrize("settings", [{}, {"protocol": "1.0"}])
def test_a_box_that_does_not_know_the_question_has_none(tmp_path: Path, settings: dict[str, Any]) -> None:
    with ledbox_world(tmp_path, **settings) as world, opened(world) as box:
        assert box.presence() is None
        assert box.self_test()["enabling switch"] == "no input for one"


def test_a_text_box_has_none(tmp_path: Path) -> None:
    with text_world(tmp_path) as world, world.opener() as box:
        assert box.presence() is None


def test_another_answer_than_0_or_1_is_no_presence(tmp_path: Path) -> None:
    with ledbox_world(tmp_path, enabling_switch="held") as world, opened(world) as box:
        link = world.box._link
        send = link.send
        world.do(lambda: setattr(link, "send", lambda data: send(data.replace(b"1;", b"ON;"))))
        with pytest.raises(DeviceError, match="0 or 1 in the answer to INPut:ENABle"):
            box.presence()

"""The picture of the rooms is that of the code, and the recipes name files that are there."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
from places import REPO

TOOL = runpy.run_path(str(REPO / "tools" / "make_architecture.py"))


def test_the_picture_of_the_rooms_shows_the_imports_as_they_are() -> None:
    drawn = re.search(r"<desc>(.*?)</desc>", (REPO / "docs/pictures/rooms.svg").read_text(), re.DOTALL)
    assert drawn is not None
    found = {f"{user} uses {used}" for user, used in TOOL["arrows"]()}
    assert set(drawn[1].splitlines()) == found, "run tools/make_architecture.py"


def test_no_room_uses_one_above_it() -> None:
    rooms = TOOL["rooms_in_order"]()
    assert [pair for pair in TOOL["arrows"]() if rooms.index(pair[0]) > rooms.index(pair[1])] == []


@pytest.mark.parametrize("page", ["docs/contributing.md", "docs/architecture.md"])
def test_files_that_a_page_names_are_there(page: str) -> None:
    roots = ("coupole/", "drivers/", "sim/", "tests/", "tools/", "configs/", "docs/")
    named = re.findall(r"`([\w./-]+)`", (REPO / page).read_text())
    inside = [Path(name) for name in named if name.startswith(roots)]
    assert inside
    assert [str(name) for name in inside if not (REPO / name).exists()] == []

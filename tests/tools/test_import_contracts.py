"""`tools/check` refuses circles among modules, wherever the import stands."""

from __future__ import annotations

import sys
from pathlib import Path

import grimp
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from import_contracts import NoCirclesContract

AT_THE_TOP = "import {package}.{name}\n"
IN_A_FUNCTION = "def use():\n    from {package} import {name}\n    return {name}\n"
FOR_TYPES = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from {package} import {name}\n"


def circles(folder: Path, package: str, modules: dict[str, str]) -> list[list[str]]:
    """What the contract finds in a package of these modules."""
    (folder / package).mkdir()
    for name, text in {"__init__": "", **modules}.items():
        (folder / package / f"{name}.py").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        graph = grimp.build_graph(package, cache_dir=None)
    checked = NoCirclesContract("circles", {}, {}).check(graph, verbose=False)
    found: list[list[str]] = checked.metadata["circles"]
    assert checked.kept == (not found)
    return found


@pytest.mark.parametrize("back", [AT_THE_TOP, IN_A_FUNCTION, FOR_TYPES], ids=["top", "function", "types"])
def test_a_circle_of_three_modules_is_told_with_the_way_round(
    tmp_path: Path, request: pytest.FixtureRequest, back: str
) -> None:
    package = f"ring_{request.node.callspec.id}"
    modules = {
        name: text.format(package=package, name=imported)
        for name, text, imported in (("a", AT_THE_TOP, "b"), ("b", AT_THE_TOP, "c"), ("c", back, "a"))
    }
    assert circles(tmp_path, package, modules) == [[f"{package}.{name}" for name in "abc"]]


def test_modules_that_share_a_third_are_no_circle(tmp_path: Path) -> None:
    to_b, to_c = (AT_THE_TOP.format(package="no_ring", name=name) for name in "bc")
    assert circles(tmp_path, "no_ring", {"a": to_c + to_b, "b": to_c, "c": ""}) == []

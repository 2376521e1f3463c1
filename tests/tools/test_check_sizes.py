"""The checker of sizes, on packages made for it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from check_sizes import violations


def function_of(lines: int) -> str:
    return "def f():\n" + "    x = 1\n" * (lines - 1)


def parameters(count: int) -> str:
    return ", ".join(f"p{number}" for number in range(count))


def write(root: Path, **modules: str) -> None:
    """Modules by their names, `__` between folders; each folder of the project is there."""
    for folder in ("coupole", "drivers", "sim", "tools"):
        (root / folder).mkdir(exist_ok=True)
    for name, text in modules.items():
        path = root / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_what_is_just_small_enough_passes(tmp_path: Path) -> None:
    method = f"class C:\n    def f(self, {parameters(7)}): ...\n"
    write(tmp_path, coupole__plan__rig="x = 1\n" * 400, sim__world=function_of(60), drivers__arm=method)
    assert list(violations(tmp_path)) == []


@pytest.mark.parametrize(
    ("modules", "message"),
    [
        ({"drivers__arm": "x = 1\n" * 401}, "drivers/arm.py: 401 lines"),
        ({"sim__world": function_of(61)}, "sim/world.py:1: f has 61 lines"),
        ({"tools__make": "@decorated\n" + function_of(60)}, "tools/make.py:1: f has 61 lines"),
        ({"drivers__arm": f"def f({parameters(8)}): ..."}, "drivers/arm.py:1: f has 8 parameters, at most 7"),
        ({"sim__arm": f"class C:\n    def f(self, *, {parameters(7)}, **more): ..."}, "f has 8 parameters"),
        ({"coupole__commands__run": f"def _f({parameters(8)}): ..."}, "_f has 8 parameters"),
        ({"coupole__plan__run": f"@cache\ndef f({parameters(8)}): ..."}, "f has 8 parameters"),
        ({"coupole__plan__shots": "", "coupole__scan__shots": ""}, "plan, scan each have a module shots"),
        ({f"coupole__room{number}__m{number}": "" for number in range(21)}, "21 rooms"),
        ({f"coupole__file{number}": "" for number in range(11)}, "11 files"),
    ],
)
def test_what_is_too_large_or_named_twice_is_told(tmp_path: Path, modules: dict[str, str], message: str) -> None:
    write(tmp_path, **modules)
    (found,) = violations(tmp_path)
    assert message in found


def test_kernels_and_commands_may_have_many_parameters(tmp_path: Path) -> None:
    kernels = "".join(
        f"@{name}\ndef f({parameters(16)}): ...\n" for name in ("kernel(parallel=True)", "numba.njit")
    )
    write(tmp_path, sim__render=kernels, coupole__commands__run=f"def run({parameters(12)}): ...")
    assert list(violations(tmp_path)) == []


def test_rooms_may_each_have_their_own_settings(tmp_path: Path) -> None:
    write(tmp_path, coupole__plan__settings="", coupole__scan__settings="")
    assert list(violations(tmp_path)) == []

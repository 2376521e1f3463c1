"""The notebooks run, in short: fewer lights and a coarser mesh than those that the site's build takes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import cells
import pytest
from places import REPO

import coupole

NOTEBOOKS = sorted((REPO / "docs/notebooks").glob("*.py"))
FIRST = "first_acquisition"
MOST_LINES = 12
PLAN = "small-demo-short"


def code_cells(path: Path) -> list[str]:
    """Code of a py:percent notebook."""
    parts = re.split(r"^# %%(.*)\n", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return [text for kind, text in zip(parts[1::2], parts[2::2], strict=True) if "[markdown]" not in kind]


def line_count(code: str) -> int:
    """Lines that are not blank."""
    return len([line for line in code.splitlines() if line.strip()])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_cell_of_code_is_long(path: Path) -> None:
    lines = [line_count(text) for text in code_cells(path)]
    assert lines
    assert max(lines) <= MOST_LINES


def run(folder: Path, name: str) -> str:
    """Run a notebook as a script, with the small plan in place of the shipped one; what it prints."""
    text = (REPO / f"docs/notebooks/{name}.py").read_text(encoding="utf-8")
    short = folder / f"{name}.py"
    short.write_text(text.replace('Plan.read("demo-short")', f'Plan.read("{PLAN}.yaml")'), encoding="utf-8")
    here = {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "MPLBACKEND": "Agg"}
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-W", "ignore:FigureCanvasAgg", short],
        cwd=folder,
        env=os.environ | here,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr[-3000:]
    return ended.stdout


@pytest.fixture(scope="module")
def acquired(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Where the notebooks run, with the run of the first, which others use; and what that prints."""
    folder = tmp_path_factory.mktemp("notebooks")
    plan = coupole.Plan.read("demo-short").model_dump()
    plan["object"] = plan["object"] | {"mesh": cells.COARSE_RELIEF}
    few = plan | {"name": PLAN, "lights": {"kind": "every", "every": 30}}
    coupole.Plan.model_validate(few).write(folder / f"{PLAN}.yaml")
    return folder, run(folder, FIRST)


def test_the_first_notebook_acquires_all_frames(acquired: tuple[Path, str]) -> None:
    assert "36 of 36 shots" in acquired[1]


def test_the_comparison_with_other_programs_has_their_numbers_of_lines() -> None:
    page = (REPO / "docs/neighbours.md").read_text(encoding="utf-8")
    for path in NOTEBOOKS:
        count = sum(line_count(text) for text in code_cells(path))
        assert path.stem == "your_own_led_box" or f"| {count} lines" in page, (path.stem, count)


PRINTS = {
    "frames_to_numbers": r"36 frames under light, \d+ dark frames",
    "reflectance": r"normals: \d\.\d\d degrees\n",
    "your_own_led_box": r"it lacks \{led\}\n.*\nlit: True\n[^$]*; one light, one exposure, one frame",
    "pigment": r"a red spot: match \(red\).*\na violet spot: unknown",
}
"""Pattern of what a notebook prints."""


@pytest.mark.parametrize("name", [path.stem for path in NOTEBOOKS if path.stem != FIRST])
def test_a_notebook_runs_to_its_end(acquired: tuple[Path, str], name: str) -> None:
    printed = run(acquired[0], name)
    assert re.search(PRINTS[name], printed), printed

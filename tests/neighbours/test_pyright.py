"""pyright takes a user's files at its strictest, and finds what is wrong in one. (It is the wheel of basedpyright,
which brings its own Node.)"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from neighbour_programs import needs_neighbours
from places import REPO

pytestmark = needs_neighbours
HOW_TO = REPO / "docs/how-to"
WRONG = """
import coupole

with coupole.open_run("run") as run:
    exposure: str = run["top"]["led0420/e0"].exposure_us
    print(exposure, run.folders)
"""


def mistakes(folder: Path, *files: Path) -> list[str]:
    """Messages of pyright about these files, in strict mode."""
    settings: dict[str, Any] = {
        "include": [str(file) for file in files],
        "extraPaths": [str(HOW_TO / "your_driver"), str(REPO)],
        "typeCheckingMode": "strict",
    }
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable, "-p", folder]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    document = json.loads(ended.stdout)
    assert document["summary"]["filesAnalyzed"] == len(files), ended.stdout
    return [f"{found['file']}: {found['message']}" for found in document["generalDiagnostics"]]


def test_the_examples_are_typed(tmp_path: Path) -> None:
    example = HOW_TO / "your_driver"
    files = (HOW_TO / "from_python.py", example / "lumen_box.py", example / "test_lumen_box.py")
    assert mistakes(tmp_path, *files) == []


@pytest.mark.parametrize("words", ['"int" is not assignable to', 'Cannot access attribute "folders"'])
def test_a_wrong_use_is_found(tmp_path: Path, words: str) -> None:
    (tmp_path / "wrong.py").write_text(WRONG)
    assert any(words in message for message in mistakes(tmp_path, tmp_path / "wrong.py"))

"""The examples of docs/how-to/from-python.md are the script beside it, which `tools/check` types strictly and
tests/tools/test_wheel.py runs."""

from __future__ import annotations

import re
import tomllib

from places import REPO

PAGE, SCRIPT = REPO / "docs/how-to/from-python.md", REPO / "docs/how-to/from_python.py"


def test_the_page_has_the_whole_script_and_nothing_else() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    script = re.sub(r'^""".*?"""\n', "", SCRIPT.read_text(), flags=re.DOTALL)
    parts = re.split(r"^# ---- .* ----\n", script, flags=re.MULTILINE)
    assert [block.strip() for block in blocks] == [part.strip() for part in parts]


def test_the_script_is_typed_strictly() -> None:
    mypy = tomllib.loads((REPO / "pyproject.toml").read_text())["tool"]["mypy"]
    assert mypy["strict"]
    assert str(SCRIPT.relative_to(REPO)) in mypy["files"]

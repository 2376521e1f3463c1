"""The public names of Python: one list, whose changes are in the CHANGELOG, documented, and cheap to import."""

from __future__ import annotations

import ast
import hashlib
import json
import subprocess
import sys

import pytest
from places import REPO

import coupole

sys.path.insert(0, str(REPO / "tools"))

from list_public_names import NAMES, PAGE, listing, page, undocumented

CHEAP = "import coupole, json, sys; print(json.dumps([sorted(sys.modules), dir(coupole)]))"


def test_the_list_is_that_of_the_code() -> None:
    assert NAMES.read_text() == listing(), "run tools/list_public_names.py and say in CHANGELOG.md what changed"
    assert PAGE.read_text() == page(), "run tools/list_public_names.py"


def test_a_change_of_the_list_is_in_the_changelog() -> None:
    digest = hashlib.sha256(NAMES.read_bytes()).hexdigest()[:8]
    changes = (REPO / "CHANGELOG.md").read_text()
    assert f"(Python names {digest})" in changes, "say what changed in the Python face, and end with these words"


def test_each_public_name_says_what_it_is() -> None:
    assert undocumented() == []


def test_types_and_code_have_the_same_names() -> None:
    stub = ast.parse((REPO / "coupole/__init__.pyi").read_text())
    (names,) = [
        ast.literal_eval(node.value)
        for node in stub.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    assert set(names) == {*coupole._NAMES, *coupole._MODULES}
    for name in names:
        assert getattr(coupole, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'acquier'"):
        _ = coupole.acquier


def test_the_import_brings_nothing_before_it_is_used() -> None:
    ended = subprocess.run([sys.executable, "-c", CHEAP], cwd=REPO, capture_output=True, text=True, check=True)
    modules, names = json.loads(ended.stdout)
    assert {"acquire", "open_run", "events"} <= set(names)
    assert [name for name in modules if name.startswith("coupole")] == ["coupole"]
    assert {"numpy", "pydantic", "h5py"} & set(modules) == set()

"""Names of persons that commands keep: none without letters, none without end."""

from __future__ import annotations

from pathlib import Path

import cells
import pytest
from cells import CellFolder


@pytest.mark.parametrize("name", ["x" * 201, "  "])
def test_a_name_is_refused_that_is_none_or_too_long(tmp_path: Path, name: str) -> None:
    cell = CellFolder(tmp_path)
    for command in (
        ("confirm", cell.rig, "--name", name),
        ("commission", cell.rig, "--name", name, "--yes"),
        ("dose", "relief", "--rig", cell.rig, "--budget", "1", "--name", name),
    ):
        refused = cells.here(*command)
        assert (refused.code, "--name" in refused.err) == (2, True), (command[0], refused.err)
        assert len(refused.err) < 1000
    assert cells.here("confirm", cell.rig, "--name", "x" * 200).code == 0

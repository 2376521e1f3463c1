"""A journal or a run.json with numbers and depths beyond reason: each command says where, none ends in a trace."""

from __future__ import annotations

from pathlib import Path

import cells
import pytest
from archives import make_run

NUMBER, DEEP = "9" * 5000, "[" * 100_000


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_run(tmp_path, shots=2).run.folder


@pytest.mark.parametrize("command", ["status", "verify", "report", "archive"])
@pytest.mark.parametrize("value", [NUMBER, DEEP], ids=["digits", "depth"])
def test_a_line_of_the_journal_that_is_refused_is_told_with_its_place(run: Path, command: str, value: str) -> None:
    journal = run / "journal.jsonl"
    lines = journal.read_text().count("\n")
    with journal.open("a") as file:
        file.write(
            '{"event":"stop","t":"2026-11-22T07:02:21.024Z","outcome":"done","robot":{"late":' + value + "}}\n"
        )
    ended = cells.here(command, run)
    assert ended.code == 6
    assert f"journal.jsonl:{lines + 1}:" in "".join(ended.err.split())
    assert "Traceback" not in ended.err


@pytest.mark.parametrize("command", ["status", "verify", "report", "archive"])
@pytest.mark.parametrize("value", [NUMBER, DEEP], ids=["digits", "depth"])
def test_a_run_json_that_is_refused_is_told_with_its_place(run: Path, command: str, value: str) -> None:
    about = run / "run.json"
    about.write_text(
        about.read_text().replace('"schema_version": 1,', f'"schema_version": 1, "more": {value},', 1)
    )
    ended = cells.here(command, run)
    assert ended.code == 2
    assert "run.json:2:" in "".join(ended.err.split())
    assert "Traceback" not in ended.err

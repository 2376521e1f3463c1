"""What the console says of a run's folder is of its files as they are now."""

from __future__ import annotations

from pathlib import Path

import pytest

from coupole.console.run_files import RunFiles

NAME = "20260101T000000Z-small"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "storage" / NAME
    for name in ("run.json", "journal.jsonl", "inputs/plan.yaml", "views/side.h5", "views/top.h5"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")
    return folder


@pytest.fixture
def runs(tmp_path: Path, run: Path) -> RunFiles:
    return RunFiles(run.parent, tmp_path / "verified")


@pytest.mark.parametrize("change", ["a view is deleted", "the plan is overwritten", "a file is added"])
def test_a_run_that_has_changed_is_no_longer_verified(runs: RunFiles, run: Path, change: str) -> None:
    runs.note_verified(NAME, "2026-01-02", runs.fingerprint(NAME))
    assert runs.row(NAME).verified == "2026-01-02"
    if change == "a view is deleted":
        (run / "views/side.h5").unlink()
    else:
        (run / ("inputs/plan.yaml" if "plan" in change else "views/new.h5")).write_text("other")
    assert runs.row(NAME).verified == ""


def test_what_changed_while_it_was_read_is_not_verified(runs: RunFiles, run: Path) -> None:
    before = runs.fingerprint(NAME)
    (run / "views/top.h5").write_text("[]")
    runs.note_verified(NAME, "2026-01-02", before)
    assert runs.row(NAME).verified == ""

"""What the console says of a run's folder is of its files as they are now."""

from __future__ import annotations

from pathlib import Path

import pytest

from coupole.console.runs.run_files import RunFiles
from coupole.errors import StorageError
from coupole.plan.shot_id import ShotId
from coupole.storage import journal
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs

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


def test_a_journal_that_grows_is_read_where_it_has_grown_and_few_runs_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("plan.yaml", "rig.yaml"):
        (tmp_path / name).write_text("{}")
    about = {"simulated": True, "views": ["top"], "labels": ["led0000/e0", "led0001/e0"]}
    inputs = Inputs(tmp_path / "plan.yaml", tmp_path / "rig.yaml", ())
    made = [Run.create(tmp_path / "runs", f"r{n}", inputs, about) for n in range(6)]
    validated = []
    monkeypatch.setattr(journal, "_of_today", lambda fields: validated.append(fields) or fields)
    runs = RunFiles(tmp_path / "runs", tmp_path / "verified")
    for run in made:
        _prove(run, 0)
        assert [str(shot) for shot in runs.proven(run.folder.name)] == ["top/led0000/e0"]
    assert len(runs._followed) == 4
    last, known = made[-1], len(validated)
    _prove(last, 1)
    assert [str(shot) for shot in runs.proven(last.folder.name)] == ["top/led0000/e0", "top/led0001/e0"]
    assert len(validated) == known + 1, "only the new line"
    with last.journal_path.open("a") as file:
        file.write('{"event": "unheard of"}\n')
    for _ in range(2):
        with pytest.raises(StorageError):
            runs.proven(last.folder.name)
    last.journal_path.unlink()
    _prove(last, 1)
    assert [str(shot) for shot in runs.proven(last.folder.name)] == ["top/led0001/e0"]


def _prove(run: Run, led: int) -> None:
    diary = Journal(run.journal_path)
    shot = ShotId.parse(f"top/led{led:04d}/e0")
    diary.write(FrameProven(shot=shot, file="views/top.h5", index=led, frame_id=led, xxh3="0" * 16))
    diary.commit()
    diary.close()

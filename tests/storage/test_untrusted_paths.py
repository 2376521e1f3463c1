"""No file of a run leads a reader out of the run's folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from archives import make_run

from coupole.acquisition.conclusion import conclude
from coupole.errors import CoupoleError, InputError, StorageError
from coupole.storage import manifest
from coupole.storage.run import Run
from coupole.viewing.terminal import make_console

ELSEWHERE = ("/dev/zero", "../elsewhere", "views/../../elsewhere", "a\0b", "")


@pytest.fixture
def run(tmp_path: Path) -> Run:
    made = make_run(tmp_path, shots=1).run
    conclude(made, make_console(quiet=True))
    return made


@pytest.mark.parametrize("path", ELSEWHERE)
def test_a_journal_that_names_a_file_elsewhere_is_refused(run: Run, path: str) -> None:
    lines = [json.loads(line) for line in run.journal_path.read_text().splitlines()]
    for line in lines:
        line.update({"file": path} if line["event"] == "frame" else {})
    run.journal_path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(StorageError, match=r"journal\.jsonl: line \d+ .* below the run's folder"):
        run.proven()


@pytest.mark.parametrize("path", ELSEWHERE)
def test_a_manifest_that_lists_a_file_elsewhere_is_refused(run: Run, path: str) -> None:
    with (run.folder / manifest.NAME).open("a") as file:
        file.write(f"{'0' * 64}  {path}\n")
    with pytest.raises(StorageError, match=r"manifest\.sha256: line \d+"):
        manifest.problems(run.folder)


@pytest.mark.parametrize("path", ELSEWHERE)
def test_a_description_whose_copies_are_elsewhere_is_refused(run: Run, path: str) -> None:
    about = json.loads((run.folder / "run.json").read_text())
    about["plan"]["stored"] = path
    (run.folder / "run.json").write_text(json.dumps(about))
    with pytest.raises(InputError, match=r"run\.json: `plan\.stored`.* below the run's folder"):
        Run(run.folder)


@pytest.mark.parametrize("content", ["[]", "7", "null", "[" * 100_000, "{", '{"schema_version": 2}'])
def test_a_description_that_is_none_is_refused(run: Run, content: str) -> None:
    (run.folder / "run.json").write_text(content)
    with pytest.raises(CoupoleError, match=r"run\.json"):
        Run(run.folder)

"""A run is not archived while another process still reads its frames."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from archives import make_run

from coupole.errors import InputError
from coupole.storage.archive import archive_run
from coupole.storage.bitshuffle import CODECS
from coupole.storage.journal_events import ProcessingAsked
from coupole.storage.processing import hold_result


def test_a_run_whose_result_is_still_made_from_its_frames_is_not_archived(tmp_path: Path) -> None:
    run, result = make_run(tmp_path / "runs").run, tmp_path / "result"
    with (run.folder / "journal.jsonl").open("a") as journal:
        journal.write(ProcessingAsked(result=str(result)).model_dump_json() + "\n")
    before = {path: path.read_bytes() for path in (run.folder / "views").iterdir()}
    with hold_result(result), pytest.raises(InputError, match=f"process {os.getpid()} still makes {result} from"):
        archive_run(run, CODECS["lz4"])
    assert {path: path.read_bytes() for path in (run.folder / "views").iterdir()} == before
    assert archive_run(run, CODECS["lz4"]).views

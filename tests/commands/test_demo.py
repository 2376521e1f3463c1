"""`coupole demo`: one at a time in a folder."""

import fcntl
import os
from pathlib import Path

import cells
import pytest

from coupole.acquisition.sequencer import Sequencer
from coupole.errors import StorageError


def test_a_second_demo_in_the_same_folder_is_refused_while_the_first_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    second: list[cells.Ended] = []

    def try_again(self: Sequencer) -> None:
        second.append(cells.finish(cells.start("demo", tmp_path / "demo", "--short", "--json")))
        raise StorageError("the end of this test's first demo")

    monkeypatch.setattr(Sequencer, "acquire", try_again)
    first = cells.here("demo", tmp_path / "demo", "--short", "--json")
    assert first.code == 6, first.err
    assert second, first.err
    assert second[0].code == 2
    assert "another demo is being made there; wait for its end" in second[0].document["error"]
    assert len(list((tmp_path / "demo/runs").iterdir())) == 1
    held = os.open(tmp_path / "demo", os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nobody holds it any more
    os.close(held)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    ended = cells.here("demo", tmp_path / "file" / "demo", "--short")
    assert ended.code == 2
    assert "cannot be used: Not a directory" in ended.err

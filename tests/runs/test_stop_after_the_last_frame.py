"""A stop that comes when all frames are there: the run is complete, but nothing follows it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.acquisition import conclusion
from coupole.acquisition.sequencer import Sequencer
from coupole.errors import DeviceLost
from coupole.storage import journal
from coupole.storage.journal_events import SessionStopped
from coupole.storage.run import Run


def _stop_after_the_last_frame(monkeypatch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    acquire = Sequencer.acquire

    def acquire_and_be_stopped(self: Sequencer) -> None:
        acquire(self)
        os.kill(os.getpid(), number)
        assert self._control.stop.wait(10.0)

    monkeypatch.setattr(Sequencer, "acquire", acquire_and_be_stopped)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_run_is_complete_and_the_command_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    cell = CellFolder(tmp_path)
    _stop_after_the_last_frame(monkeypatch, number)
    ended = cells.here("acquire", cell.plan, "--yes", "--json")
    assert ended.code == 128 + number, ended.err
    assert ended.document["exit_code"] == ended.code
    run = Run(Path(ended.document["run"]))
    last = list(journal.read_events(run.journal_path))[-1]
    assert isinstance(last, SessionStopped)
    assert last.outcome == "done"
    assert cells.here("verify", run.folder).code == 0


def test_a_command_of_several_steps_goes_no_further(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _stop_after_the_last_frame(monkeypatch, signal.SIGTERM)
    ended = cells.here("demo", tmp_path / "demo", "--short", "--json")
    assert ended.code == 143, ended.err
    assert not (tmp_path / "demo" / "reflectance").exists()


def test_a_signal_while_files_are_hashed_ends_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = CellFolder(tmp_path)
    monkeypatch.setattr(conclusion, "_enter", lambda *_: signal.raise_signal(signal.SIGTERM))
    ended = cells.here("acquire", cell.plan, "--yes", "--json")
    assert ended.code == 143, ended
    assert Run(Path(ended.document["run"])).folder.is_dir()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_end_of_a_failed_run_is_written_does_not_hide_the_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    cell = CellFolder(tmp_path)
    lost = DeviceLost("robot", expected="an answer", happened="none came", remedy="Look at the arm.")

    def fail(self: Sequencer) -> None:
        raise lost

    monkeypatch.setattr(Sequencer, "acquire", fail)
    monkeypatch.setattr(conclusion, "_report", lambda _: signal.raise_signal(number))
    ended = cells.here("acquire", cell.plan, "--yes", "--json")
    assert ended.code == 4, ended
    assert "none came" in ended.document["error"]
    assert "Look at the arm." in ended.err

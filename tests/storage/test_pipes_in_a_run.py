"""A pipe in the place of a run's file is refused: nobody writes to it, and a reader would wait for ever."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from coupole.errors import CoupoleError
from coupole.storage import durable, frame_file, journal, manifest
from coupole.storage.run import Run

_READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "description": ("run.json", lambda path: Run(path.parent)),
    "events": ("journal.jsonl", lambda path: list(journal.read_events(path))),
    "tail": ("journal.jsonl", lambda path: journal.tail(path, 1000)),
    "news": ("journal.jsonl", lambda path: journal.Follower(path).news()),
    "manifest": ("manifest.sha256", lambda path: manifest.read_checksums(path.parent)),
    "view": ("top.h5", frame_file.read_layout),
    "checksum": ("top.h5", durable.sha256),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("reader", _READERS)
def test_a_pipe_is_refused_and_not_waited_for(reader: str, tmp_path: Path) -> None:
    name, read = _READERS[reader]
    os.mkfifo(tmp_path / name)
    with pytest.raises((CoupoleError, OSError), match="a pipe or a device, expected a file"):
        read(tmp_path / name)

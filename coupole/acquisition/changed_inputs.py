"""Tells if a job's files on the disk have changed since they were read. The run uses and keeps the files as they
were read."""

from __future__ import annotations

import threading

from rich.console import Console

from coupole.acquisition.recorder import Recorder
from coupole.intake.input_files import InputFiles
from coupole.storage.journal_events import InputsChanged

_LONGEST_S = 5.0


def tell_changes(files: InputFiles, recorder: Recorder, console: Console) -> None:
    """One line for the operator for each file that changed since the last call, and one in the journal for all."""
    changes: list[str] = []
    looking = threading.Thread(target=lambda: changes.extend(files.changes()), daemon=True)
    looking.start()
    looking.join(_LONGEST_S)  # a disk that does not answer must not hold up a session's end
    for sentence in changes:
        console.print(
            f"{sentence} since it was read; the run uses and keeps the content that was read", markup=False
        )
    if changes:
        recorder.note(InputsChanged(files=tuple(changes)))

"""Takes the samples of a run and discards its frames, and is killed at a step, in a process of the nursery.

A step is the name of a function, and whether SIGKILL comes `before` or `after` its first call.
"""

from __future__ import annotations

import importlib
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coupole.reflectance.run_job import RunRequest, extract_runs, reflectance_of
from coupole.storage.line_file import LineFile

STEPS = {
    "the samples are written, their summary is not": "before coupole.reflectance.run_job.write_synced",
    "they are synced, not read back": "before coupole.reflectance.run_job.prove_written",
    "they are read back, it is not noted": "before coupole.storage.sample_proofs.note",
    "it is noted, the journal has nothing": "before coupole.reflectance.discarded_frames.discard",
    "the journal's line is cut": "half coupole.storage.journal.append_lines",
    "the journal has the line": "after coupole.storage.journal.append_lines",
    "a part of the frames is marked": "after coupole.storage.discarding._write",
    "the frames are marked": "before coupole.storage.discarding.give_back",
    "their space is given back": "after coupole.storage.discarding.give_back",
}
REWRITTEN = {
    "the new samples are written, not noted": "before coupole.reflectance.discarded_frames.note",
    "they are noted, not in place": "after coupole.reflectance.discarded_frames.note",
}


def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_at(step: str) -> None:
    """Have a function kill this process."""
    when, _, place = step.partition(" ")
    module_name, _, name = place.rpartition(".")
    module = importlib.import_module(module_name)
    real: Callable[..., Any] = getattr(module, name)

    def killed(*arguments: Any, **named: Any) -> None:
        if when == "half":
            LineFile.append = _append_half  # type: ignore[method-assign]
        if when != "before":
            real(*arguments, **named)
        die()

    setattr(module, name, killed)


def _append_half(file: LineFile, lines: list[str]) -> None:
    data = "".join(lines).encode()
    os.write(file._fd, data[: len(data) // 2])
    die()


def discard(step: str, run: str, out: str) -> None:
    """To its end, if the step has no name here."""
    whole = {**STEPS, **REWRITTEN}
    request = RunRequest((Path(run),))
    if step in REWRITTEN:
        extract_runs(request, Path(out))
    if step in whole:
        die_at(whole[step])
    (reflectance_of if step in REWRITTEN else extract_runs)(request, Path(out))

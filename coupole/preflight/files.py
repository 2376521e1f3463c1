"""Files, read and checked: the answer of `coupole check` for a plan, or for the rest of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coupole.preflight.job import Job
    from coupole.preflight.preflight import Report


@dataclass(frozen=True)
class Files:
    """Files that are to be checked."""

    plan: Path
    rig: Path | None = None
    """None: the plan's rig."""
    resume: Path | None = None
    """The run whose remaining part is checked."""
    output: Path | None = None
    """Parent folder of the run; None: the rig's folder for runs."""


def check_files(
    files: Files,
    *,
    paths: bool = True,
    measure: bool = True,
    say: Callable[[str], object] = lambda _: None,
) -> tuple[Job, Report]:
    """Return the job at the pace that LEDs and disk allow, and preflight's report on it.

    Without `paths`, collisions are not checked. The disk's speed is known only with `measure`. `say` is called
    with each step in words. Raises InputError if a file is wrong, or differs from the file that the run began
    with; StorageError.
    """
    from coupole.preflight.checking import preflight_of
    from coupole.preflight.job import read_job, without_hidden
    from coupole.storage.run import Occupied, Run

    say("reading plan, mesh and records")
    job = read_job(files.plan, files.rig)
    run = Run(files.resume) if files.resume else None
    if run is not None:
        run.refuse_changes(job.inputs)
    if run is not None or paths:
        say("computing paths and hidden lights")
        job = without_hidden(job, run.hidden_leds if run else None)
    folder = run.folder if run else files.output or job.cell.storage_folder
    occupied_space, proven = (run.occupied_space(), run.proven()) if run else (Occupied(), {})
    return preflight_of(
        job, folder, paths=paths, occupied_space=occupied_space, proven=proven, measure=measure, say=say
    )

"""Progress of the processing that runs beside an acquisition, kept in the folder of its result.

::

    RESULT/beside/          only until the result is complete
      samples.json          frames that the samples of each view were taken from; synced
      progress.json         progress, for people: written again and again, never synced
      lock                  locked by the process at work
      pictures/             normals and materials of the views so far (`coupole.storage.growing_pictures`)
      RUN-2-of-3-views-.../ result of the views so far (`coupole.storage.so_far`)

The run's journal names the result's folder (`ProcessingAsked`); nothing else connects the two processes.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.storage.stopped_process import holder_of, is_locked, is_stopped

FOLDER = "beside"
RESULT = "result.json"
"""File that a complete result has."""
LOCK, PROGRESS = f"{FOLDER}/lock", f"{FOLDER}/progress.json"
_SUFFIX = "-reflectance"
Step = Literal["waiting", "extracting", "growing", "fitting", "failed"]
_own_results: set[Path] = set()
"""Results that this process has locked."""


class Progress(BaseModel):
    """Progress as the process tells it."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    step: Step = "waiting"
    views_done: Annotated[int, Field(ge=0)] = 0
    """Views whose samples are there."""
    views: Annotated[int, Field(ge=0)] = 0
    """Views of the plan."""
    detail: str = ""
    """Name of the present part of a step, such as a fit."""
    done_count: Annotated[int, Field(ge=0)] = 0
    """Number of parts of `detail` that are done."""
    of: Annotated[int, Field(ge=0)] = 0
    """Number of parts of `detail`."""
    fitted_views: Annotated[int, Field(ge=0)] = 0
    """Number of views in the result so far; 0 while there is no result."""
    why: str = ""
    """Reason of a failure, or of the end of the process."""
    undrawn: str = ""
    """The newest picture or page that could not be drawn, and the reason."""


@dataclass(frozen=True)
class Processing:
    """State of the processing of a run."""

    result: str
    """Folder of the result."""
    state: Literal["waiting", "extracting", "growing", "fitting", "done", "failed", "ended"]
    """`waiting`: for a complete view. `extracting`: samples of a view. `growing`: fitting the views so far.
    `fitting`: after the last view. `done`. `failed`. `ended`: before the result was complete."""
    views_done: int = 0
    """Views whose samples are there."""
    views: int = 0
    """Views of the plan."""
    fitted_views: int = 0
    """Number of views of the result so far, `RESULT/so-far`; 0 while there is no such result, and when the result
    is complete."""
    detail: str = ""
    """The present fit or other step, with the share of it that is done."""
    why: str = ""
    """Reason why it failed, ended or stands still."""
    remedy: str = ""
    """The command line that continues with the present data; empty while nothing is wrong."""
    undrawn: str = ""
    """The newest picture or page that could not be drawn, and the reason."""

    def figures(self) -> dict[str, Any]:
        """Content of `processing` in `--json`."""
        return asdict(self)

    @property
    def is_at_work(self) -> bool:
        """Tell whether its process is there."""
        return self.state not in ("done", "failed", "ended")

    @property
    def words(self) -> str:
        """Return the state of the processing in a few words."""
        views = f"{self.views_done} of {self.views} views extracted"
        if self.fitted_views:
            views += f", result so far of {self.fitted_views}"
        match self.state:
            case "done":
                return f"done: {self.result}"
            case "failed" | "ended":
                return f"{self.state}, {views}: {self.why}"
            case _:
                detail = f", {self.detail}" if self.detail else ""
                still = f" ({self.why})" if self.why else ""
                return f"{self.state}, {views}{detail}{still}"


def default_result(run: Path) -> Path:
    """Return the folder of a run's result if no folder was named. It is beside the run's folder."""
    return run.with_name(run.name + _SUFFIX)


def go_on_command(run: Path, result: Path) -> str:
    """Return the command line that makes the result of a complete run, from its present data."""
    return f"coupole reflectance {shlex.quote(str(run))} --out {shlex.quote(str(result))}"


def tell(result: Path, progress: Progress) -> None:
    """Write the progress for `processing_of`. It is not synced, because it must not slow the acquisition. Raises
    OSError."""
    path = result / PROGRESS
    part = path.with_suffix(".json.part")
    part.write_text(progress.model_dump_json() + "\n", encoding="utf-8")
    part.replace(path)


def processing_of(run: Path, result: Path, *, frames_left: bool, in_use: bool) -> Processing:
    """Return the state of the processing of a run into a result. With `frames_left`, the run is not complete; with
    `in_use`, a process acquires into it."""
    progress = _read_progress(result)
    place = str(result)
    if not frames_left and _is_whole(run, result):
        return Processing(place, "done", progress.views_done, progress.views)
    counts = progress.views_done, progress.views, progress.fitted_views
    remedy = "" if frames_left else go_on_command(run, result)
    if progress.step == "failed":
        return Processing(place, "failed", *counts, why=progress.why, remedy=remedy)
    if not _is_held(result / LOCK):
        if in_use and not counts[1]:
            return Processing(place, "waiting")
        why = progress.why or "its process ended before the result was complete"
        return Processing(place, "ended", *counts, why=why, remedy=remedy)
    share = f" {progress.done_count} of {progress.of}" if progress.of else ""
    pid = holder_of(result / LOCK)
    still = f"its process {pid} is stopped; `kill -CONT {pid}` lets it go on" if pid and is_stopped(pid) else ""
    return Processing(
        place, progress.step, *counts, detail=f"{progress.detail}{share}", why=still, undrawn=progress.undrawn
    )


def _is_whole(run: Path, result: Path) -> bool:
    """Tell whether a folder has the complete result of this run, and not of another one."""
    with contextlib.suppress(OSError, InputError):
        about = read_json(result / RESULT, allow_nan=True)
        return isinstance(about, dict) and list(about.get("runs", ())) == [run.name]
    return False


def _read_progress(result: Path) -> Progress:
    """Return the progress. It is empty if no progress was written yet, or if the file is not valid."""
    try:
        return Progress.model_validate(read_json(result / PROGRESS))
    except (OSError, InputError, ValidationError):
        return Progress()


@contextmanager
def hold_result(result: Path) -> Iterator[None]:
    """Keep a result for this process: make its folder, and lock it while the context lasts. Raises InputError if
    another process has it, OSError."""
    (result / FOLDER).mkdir(parents=True, exist_ok=True)
    fd = os.open(result / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(_at_work(result)) from error
        _own_results.add(result.resolve())
        yield
    finally:
        _own_results.discard(result.resolve())
        os.close(fd)


def refuse_held(result: Path) -> None:
    """Raise InputError if another process is making a result beside an acquisition."""
    if result.resolve() not in _own_results and _is_held(result / LOCK):
        raise InputError(_at_work(result))


def refuse_while_processed(run: Path, result: Path) -> None:
    """Raise InputError while a process makes the result of a run from the run's frames."""
    if _is_held(result / LOCK):
        raise InputError(
            f"{run}: {_worker(result)} still makes {result} from its frames; `coupole status RUN` shows the "
            "progress. Wait until it has ended"
        )


def _worker(result: Path) -> str:
    pid = holder_of(result / LOCK)
    return f"process {pid}" if pid else "another process"


def _at_work(result: Path) -> str:
    return (
        f"{result}: {_worker(result)} makes this result during the acquisition; "
        "`coupole status RUN` shows its progress. Wait until it has ended, or name another folder with --out"
    )


def _is_held(lock: Path) -> bool:
    try:
        return is_locked(lock)
    except OSError:
        return False

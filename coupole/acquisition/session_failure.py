"""Notes what went wrong at a session's end. Each call to the file system is bounded."""

from __future__ import annotations

import contextlib
import traceback
from functools import partial

from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.recorder import RunRecorder
from coupole.bounded import NOW, hangs, left_behind, on_disk, run_bounded
from coupole.errors import CoupoleError, DeviceError, StorageError
from coupole.storage.arm_faults import ArmFaults
from coupole.storage.journal_events import FaultNoted
from coupole.storage.line_file import utc_now
from coupole.storage.run import Run
from coupole.viewing.terminal import alarm


def statistics(cell: OpenedCell) -> dict[str, float]:
    """Return the statistics of the arm's link; empty if its driver can no longer give them."""
    try:
        return {} if hangs("robot") else dict(run_bounded(cell.robot.statistics, stop=NOW))
    except Exception:  # noqa: BLE001  the session's end is told without them
        return {}


def note_failure(error: BaseException, cell: OpenedCell, run: Run, recorder: RunRecorder) -> None:
    """Note the failure in the journal. For an unexpected error, also write its trace to the run's folder, and say
    so.
    """
    device = error.device if isinstance(error, DeviceError) else ""
    recorder.note(FaultNoted(kind=type(error).__name__, message=str(error), device=device))
    if isinstance(error, CoupoleError):
        return
    path = run.folder / f"trace-{utc_now().replace(':', '')}.txt"
    trace = "".join(traceback.format_exception(error))
    with contextlib.suppress(OSError, StorageError):
        on_disk(str(path), lambda: path.write_text(trace, encoding="utf-8"), stop=NOW)
    safe = "; ".join(cell.trouble) or "lights are off, the arm is at rest, the camera is disarmed"
    error.add_note(f"{safe}; the trace is in {path}; continue with `{run.go_on_command}`")


def note_what_hangs(error: BaseException, cell: OpenedCell, run: Run, recorder: RunRecorder) -> None:
    """Report a call that was given up before the operator's stop ended the session."""
    if left_behind():
        alarm(str(error))
        note_failure(error, cell, run, recorder)


def note_faults_of_the_arm(failure: BaseException | None, cell: OpenedCell, run: Run, faults: ArmFaults) -> None:
    """Keep the arm's faults with the cell until a person confirms that the arm may move again."""
    fault = str(failure) if isinstance(failure, DeviceError) and failure.device == "robot" else ""
    if not fault and not cell.arm_confirmed:
        fault = "; ".join(cell.trouble)
    if fault:
        try:
            on_disk(faults.where, partial(faults.note, fault, run.folder.name), stop=NOW)
        except StorageError as error:
            cell.trouble.append(f"the arm's fault could not be recorded: {error}")

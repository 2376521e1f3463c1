"""Begin and end of a session for the run's folder: its manifest and its report. No device is open when a session
concludes."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from coupole.acquisition.recorder import RunRecorder
from coupole.acquisition.signals import SignalReceived
from coupole.bounded import DISK, hangs, left_behind, on_disk, run_bounded, under_way
from coupole.errors import StorageError
from coupole.storage import journal, manifest, run_dose
from coupole.storage.discarding import discarded_views
from coupole.storage.journal_events import ProcessingAsked, SessionResumed, SessionStopped, TextUnread
from coupole.storage.run import Run
from coupole.storage.run_inputs import FOLDER as INPUTS_FOLDER
from coupole.viewing import report
from coupole.viewing.terminal import alarm, bytes_text
from coupole.viewing.text_outlet import unread

MOST_HASHED_BYTES = 2_000_000_000
"""Most bytes of complete views that a session hashes, so that it ends soon. `verify --manifest` or `archive`
hashes more."""
_SLOWEST_BYTES_S, _REPORT_S = 10e6, 60.0


def open_for_session(run: Run) -> None:
    """Remove from the manifest the files that the session may write."""
    manifest.open_for_session(run.folder, complete_views(run))


def complete_views(run: Run) -> list[str]:
    """Return the files of the views whose frames are all proven, relative to the run. Nothing writes into these
    files any more. If the plan discards frames, a view counts only when its frames are discarded.
    """
    views, gone_views = run.complete_views(), discarded_views(run)
    files = (run.view_path(view) for view in views if view in gone_views or not run.discards)
    return [str(path.relative_to(run.folder)) for path in files if path.is_file()]


def renew_report(run: Run) -> Path:
    """Write the report again, and enter it in the manifest unless a session is writing the run. Raises
    StorageError."""
    if run.in_use:
        return report.write(run)
    with run.hold_lock():
        manifest.forget(run.folder, [run.report_path.name])
        path = report.write(run, in_use=False)
        manifest.enter(run.folder, [run.report_path.name])
    return path


def close_complete(run: Run, console: Console, result: Path | None = None) -> float:
    """End a session of a run whose frames are all there, for example because it was killed before it could record
    this. No device is opened. `result` is the folder of the result that is requested beside the run. Returns the
    run's light in lux hours."""
    console.print("all frames are there; no device is opened")
    open_for_session(run)
    writer = journal.Journal(run.journal_path)
    writer.write(SessionResumed(simulated=run.is_simulated))
    if result is not None:
        writer.write(ProcessingAsked(result=str(result)))
    writer.write(SessionStopped(outcome="done"))
    writer.commit()
    writer.close()
    conclude(run, console)
    return run_dose.highest_lux_h(journal.read_events(run.journal_path))


def conclude(run: Run, console: Console) -> None:
    """Write the report and enter the complete files in the manifest. Raises only signals, because the run itself
    has ended. A disk that hung in the session is not used again. If the folder is lost, nothing is done.
    """
    if run.is_lost:
        return
    try:
        if call := hangs(DISK):
            raise StorageError(f"{call}: the disk does not answer")
        views, size = on_disk(str(run.folder), lambda: _report(run), _REPORT_S)
        console.print(f"  report  {run.report_path}")
        if size > MOST_HASHED_BYTES:
            console.print(
                f"  {bytes_text(size)} of frames are not in {manifest.NAME} yet: "
                f"`coupole verify {run.folder} --manifest` enters them"
            )
        elif views:
            run_bounded(lambda: _enter(run, views, size))
    except (KeyboardInterrupt, SignalReceived):
        console.print(f"  {manifest.NAME} is not complete: `coupole verify {run.folder} --manifest` completes it")
        raise
    except Exception as error:  # noqa: BLE001  it must not hide what ended the run
        message = f"the report or {manifest.NAME} could not be written:"
        if left_behind():
            alarm(f"{message} {error}")
        else:
            console.print(f"  [yellow]{message}[/] {error}")


def _report(run: Run) -> tuple[list[str], int]:
    """Write the report, and list the small complete files. Also return the complete views that are not listed, and
    their bytes."""
    report.write(run, in_use=False)
    unlisted_files = manifest.unlisted_files(run.folder)
    inputs = f"{INPUTS_FOLDER}/"  # views are listed when they are complete; other folders are not the run's
    manifest.enter(run.folder, [name for name in unlisted_files if "/" not in name or name.startswith(inputs)])
    digests = manifest.read_checksums(run.folder)
    views = [name for name in complete_views(run) if name not in digests]
    return views, sum((run.folder / name).stat().st_size for name in views)


def _enter(run: Run, views: list[str], size: int) -> None:
    """Enter the files in the manifest. Hashing has the lowest priority: it may be slow beside other work, but it
    must go on."""
    with under_way(DISK, str(run.folder), size / _SLOWEST_BYTES_S) as reading:
        manifest.enter(run.folder, views, on_read=reading.goes_on)


def note_unread(recorder: RunRecorder) -> None:
    """Note in the journal that the session's text was not read, so that the session did not wait for its
    reader."""
    if unread_text := unread():
        recorder.note(
            TextUnread(
                lost_lines=unread_text.lost_lines,
                lost_bytes=unread_text.lost_bytes,
                waiting_bytes=unread_text.waiting_bytes,
                stalled_s=round(unread_text.stalled_s, 1),
            )
        )

"""Discards frames whose samples are safe, if the run's plan says so (`discard: after_fit`).

A frame is the only copy of a measurement. So the order is: the samples of a view are written and synced, then read
back and compared with the written ones (`coupole.storage.sample_proofs`). Then the journal's line is synced, the
frames are marked in the view's file, and their space is given back in place. After a crash between two of these
steps, either the frames are there, or their samples are safe and the journal says so. `finish` then does the rest.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import ChecksumMismatch, StorageError
from coupole.plan.held_out import held_out_leds
from coupole.plan.shot_id import Led, PanelMark, Sentinel, ShotId
from coupole.storage import frame_file, journal, manifest
from coupole.storage.disk_errors import disk_error
from coupole.storage.frame_file import DISCARDED, FRAME_DTYPE, FREE, PROVEN, Layout
from coupole.storage.given_back import give_back, is_blank
from coupole.storage.journal_events import (
    Event,
    FindingNoted,
    FrameProven,
    FramesDiscarded,
    SessionResumed,
    SessionStopped,
    ViewBegun,
    ViewSealed,
)
from coupole.storage.run import Run
from coupole.storage.sample_proofs import SAMPLES, has_proofs

NOT_YET = "the session has not finished it yet"


def is_needed(shot: ShotId, held_out: Iterable[int]) -> bool:
    """Tell whether a frame is kept. All frames are kept except those under single LEDs that are not held out for
    the check."""
    return not isinstance(shot.light, Led) or shot.light.id in held_out


def discarded_views(run: Run) -> dict[str, FramesDiscarded]:
    """Return the discarded frames by name of view, from the journal."""
    events = journal.read_events(run.journal_path) if run.discards else ()
    return {event.view: event for event in events if isinstance(event, FramesDiscarded)}


def place_of_result(run: Run, event: FramesDiscarded) -> Path:
    """Return the folder of the result that replaces discarded frames. It is beside the run, if both were moved, or
    at the place in the journal."""
    path = Path(event.result)
    beside = run.folder.with_name(path.name)
    return beside if has_proofs(beside) else path


def reason_to_keep(run: Run, view: str) -> str:
    """Return the reason why the frames of a view must not be discarded, or must not be discarded yet, even if its
    samples are safe. It is empty if they may be discarded."""
    if not run.discards:
        return "the plan does not say `discard: after_fit`"
    events = list(journal.read_events(run.journal_path))
    if any(isinstance(event, FindingNoted) and event.view == view for event in events):
        return "a disturbance was found while it was taken, and its frames are marked"
    if incomplete := incomplete_until(run, view):
        return f"the view {incomplete} is not complete"
    if not _is_finished(events, view):
        return NOT_YET
    if frame_file.read_layout(run.view_path(view)).is_archived:
        return "its file is archived"
    return ""


def incomplete_until(run: Run, view: str) -> str:
    """Return the first incomplete view among this view and the views begun before it, whose dark frames count in
    its samples. It is empty if all are complete; the view's samples will then not change any more."""
    complete_views = set(run.complete_views())
    for begun_view in dict.fromkeys(
        shot.view for shot in run.proven() if not isinstance(shot.light, PanelMark | Sentinel)
    ):
        if begun_view not in complete_views:
            return begun_view
        if begun_view == view:
            return ""
    return view


def _is_finished(events: Sequence[Event], view: str) -> bool:
    """Tell whether the session has finished a view whose frames are all there, or has ended."""
    places = [n for n, event in enumerate(events) if isinstance(event, FrameProven) and event.shot.view == view]
    if not places:
        return False
    return any(
        isinstance(event, SessionResumed | SessionStopped)
        or (isinstance(event, ViewSealed) and event.view == view)
        or (isinstance(event, ViewBegun) and event.view != view)
        for event in events[places[-1] :]
    )


def to_discard(run: Run, view: str, result: Path, digest: str) -> FramesDiscarded | None:
    """Return the journal's event for a view whose samples in a result are safe, with this digest; None if the view
    has no frame to discard. The caller has checked `reason_to_keep` before."""
    expected_shots = list(run.expected_shots())
    held_out = set(held_out_leds({shot.light.id for shot in expected_shots if isinstance(shot.light, Led)}))
    frames = tuple(
        (shot, frame.xxh3)
        for shot, frame in run.proven().items()
        if shot.view == view and not is_needed(shot, held_out)
    )
    if not frames:
        return None
    return FramesDiscarded(
        view=view, frames=frames, result=str(result), samples=f"{SAMPLES}/{view}.h5", digest=digest
    )


def discard(run: Run, event: FramesDiscarded, note: Callable[[FramesDiscarded], None]) -> None:
    """Discard the frames of an event. First `note` writes the event to the journal on the disk. Only the process
    that holds the run's lock may call this. Raises ChecksumMismatch, before anything is done, if the view's file
    does not have these frames; StorageError."""
    path = run.view_path(event.view)
    layout = _layout(path)
    slots = _slots(path, event)
    note(event)
    _give_back(path, layout, slots)


def finish(run: Run) -> None:
    """Give back the space of frames that the journal lists as discarded, if a crash has left it. If a file changes
    by this, it is taken out of the manifest first. Only the process that holds the run's lock may call this.
    Raises StorageError."""
    for event in discarded_views(run).values():
        path = run.view_path(event.view)
        if path.exists() and not frame_file.read_layout(path).is_archived:
            layout, slots = _layout(path), _slots(path, event)
            if not _is_given_back(path, layout, slots):
                manifest.forget(run.folder, [str(path.relative_to(run.folder))])
            _give_back(path, layout, slots)


def append_to_journal(run: Run) -> Callable[[FramesDiscarded], None]:
    """Return the `note` of `discard` for a run that no session is writing."""
    return lambda event: journal.append_lines(run.journal_path, [journal.event_line(event)])


def _layout(path: Path) -> Layout:
    layout = frame_file.read_layout(path)
    if layout.is_archived:
        raise StorageError(f"{path}: is archived, so its frames are not discarded")
    return layout


def _slots(path: Path, event: FramesDiscarded) -> NDArray[np.int64]:
    """Return [n] slots of the frames, in rising order."""
    table = frame_file.read_frames(path)
    states = np.isin(table["state"], (PROVEN, DISCARDED))
    slot_of = {(bytes(table[slot]["shot"]), int(table[slot]["xxh3"])): slot for slot in np.flatnonzero(states)}
    try:
        return np.array(
            sorted(slot_of[str(shot).encode(), int(xxh3, 16)] for shot, xxh3 in event.frames), np.int64
        )
    except (KeyError, ValueError) as error:
        raise ChecksumMismatch(
            f"{path}: does not have the frames of {event.view} as the journal has them ({error}); nothing was "
            "discarded"
        ) from error


def _is_given_back(path: Path, layout: Layout, slots: NDArray[np.int64]) -> bool:
    """Tell whether `_give_back` would leave every byte of a file unchanged."""
    table = frame_file.read_frames(path)
    if not (table["state"][slots] == DISCARDED).all():
        return False
    try:
        with path.open("rb") as file:
            return is_blank(file.fileno(), _empty_parts(layout, table))
    except OSError as error:
        raise disk_error(path, error) from error


def _give_back(path: Path, layout: Layout, slots: NDArray[np.int64]) -> None:
    """Mark the slots, then give back their space. The marks come first, so that a reader never mistakes a hole for
    a frame. Slots without a frame are given back too."""
    table = frame_file.read_frames(path)
    table["state"][slots] = DISCARDED
    try:
        fd = os.open(path, os.O_RDWR)
        try:
            for first, end in _stretches(slots):
                _write(fd, table[first:end].tobytes(), layout.table_offset + first * FRAME_DTYPE.itemsize)
            os.fsync(fd)
            give_back(fd, _empty_parts(layout, table))
        finally:
            os.close(fd)
    except OSError as error:
        raise disk_error(path, error) from error


def _empty_parts(layout: Layout, table: NDArray[np.void]) -> Iterator[tuple[int, int]]:
    """Yield offset and length in bytes of each stretch of slots that have no frame, or no longer have one."""
    empty_slots = np.flatnonzero(np.isin(table["state"], (DISCARDED, FREE)))
    size = layout.frame_bytes
    for first, end in _stretches(empty_slots):
        yield layout.data_offset + first * size, (end - first) * size


def _stretches(slots: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return first and end of each stretch of slots. The slots are in rising order."""
    stretches = np.split(slots, np.flatnonzero(np.diff(slots) > 1) + 1)
    return [(int(stretch[0]), int(stretch[-1]) + 1) for stretch in stretches if len(stretch)]


def _write(fd: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        count = os.pwrite(fd, view, offset)
        view, offset = view[count:], offset + count

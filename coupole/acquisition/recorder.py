"""Recorders for a run's frames and events: the recorder that the sequencer needs, and the recorder of a run
folder."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.frame_samples import FrameSamples, frame_sample
from coupole.bounded import DISK, NOW, Workers, hangs, left_behind, on_disk, run_bounded, under_way
from coupole.devices import ArmState, Frame, FrameFormat
from coupole.errors import StorageError
from coupole.geometry import Transform
from coupole.plan.bursts import Burst
from coupole.plan.choices import FrameSample
from coupole.plan.shot_id import ShotId
from coupole.storage import journal, run_dose
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import make_folder, write_synced
from coupole.storage.frame_file import SPARE_SLOTS
from coupole.storage.frame_file_creation import Collections, create
from coupole.storage.journal import FRAME_LINE, Journal, append_lines, event_line
from coupole.storage.journal_events import Event, FrameProven
from coupole.storage.run import Run
from coupole.storage.view_reader import View, read_view, refuse_lost
from coupole.storage.view_writer import ViewWriter

COMMIT_EVERY_S = 0.5
PICTURES = "watch"
"""Folder of a run with pictures of what was found while it was acquired."""
_SLOWEST_SYNC_BYTES_S, _SLOWEST_ALLOCATION_BYTES_S = 5e6, 50e6
"""Speeds of the slowest disks that still answer. An allocation may be written out."""


@dataclass(frozen=True)
class ViewStart:
    """A view before its first frame."""

    view: str
    """Name of the view."""
    frames: int
    """Number of its frames, at most."""
    frame_format: FrameFormat
    arm: ArmState
    """State of the arm, which is at rest."""
    base_from_camera: Transform
    """Pose of the camera, mm."""
    collections: Collections
    """Arrays to be stored with the frames: by group name, then by array name."""


class Recorder(Protocol):
    """The recorder that the sequencer needs. Several threads may call `store`; all other methods are called by
    only one thread."""

    name: str
    """Purpose of the light, in the object's dose ledger: the run's name, or `meter`."""

    def light_before_lux_h(self) -> tuple[float, ...]:
        """Light of earlier sessions of the run at each dose point of the object; empty if there was none."""
        ...

    def proven(self) -> set[ShotId]:
        """Shots proven so far, also in an earlier session of the run."""
        ...

    def has_room(self, view: str) -> bool:
        """Tell whether the disk has room for a view that is about to begin. Raises DiskFull if it never will."""
        ...

    def begin_view(self, start: ViewStart) -> None:
        """Begin a view: the next frames belong to it. May be called again after a new measurement of the pose."""
        ...

    def store(self, frame: Frame, exposure_us: int) -> int:
        """Store an unproven frame; returns its slot."""
        ...

    def sample_frames(self, *, is_wanted: bool) -> None:
        """Switch on or off whether new frames are sampled for `sample`."""
        ...

    def sample(self, shot: ShotId) -> FrameSample:
        """Return the sample of a proven frame of the current view. For a frame of an earlier session, it is made
        from the disk. Raises StorageError."""
        ...

    def earlier_pixels(self, shot: ShotId) -> NDArray[np.uint16]:
        """Return [H, W], DN: a frame that an earlier session has proven, from the disk. Raises StorageError."""
        ...

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None: ...

    def see_mark(self, slot: int, burst: Burst, step: int) -> None:
        """Receive the frame of a mark that has no label; the frame is freed afterwards. A burst has these marks if
        it is taken again or if a resumed run completes it, because the frames of its first marks are kept
        already."""
        ...

    def free(self, slot: int) -> None: ...

    def note(self, event: Event) -> None:
        """Note an event for the journal."""
        ...

    def keep_picture(self, name: str, content: bytes) -> str:
        """Keep the PNG file of a finding; returns its path in the run, empty where there is no run. Raises
        StorageError."""
        ...

    def commit(self, *, now: bool) -> None:
        """Write proven frames and events to disk; with `now=False` only if the last commit was some time ago."""
        ...

    def end_view(self) -> None: ...


class RunRecorder:
    """Recorder into a run folder."""

    def __init__(
        self,
        run: Run,
        metadata: Mapping[str, Any],
        collections: Collections | None = None,
        *,
        is_packed: bool = False,
    ) -> None:
        """`collections` is stored in each view's file, beside the view's own collections. If `is_packed`, frames
        may be stored as two pixels in three bytes."""
        self._run, self._metadata, self._packed = run, dict(metadata), is_packed
        self.name = run.folder.name
        self._described = dict(collections or {})
        self._journal = Journal(run.journal_path)
        self._proven = {shot: frame.index for shot, frame in run.proven().items()}
        self._samples = FrameSamples()
        self._writer: ViewWriter | None = None
        self._file = ""
        self._pose = 0
        self._read_back: dict[str, tuple[View, dict[ShotId, FrameProven]]] = {}
        """The view's file and its frames of an earlier session. It is read when one of these frames is needed."""
        self._committed_s = time.monotonic()
        self._committer = Workers(1, "commit")
        self._committing: Future[None] | None = None
        self._unsynced_bytes = 0
        self._uncommitted: list[ShotId] = []
        self.has_room_for: Callable[[str], bool] = lambda view: True
        """Answer of `has_room`. If frames are discarded during the session, more room may become free."""
        self.committed = set(self._proven)
        """Proven shots whose lines are on the disk."""

    def light_before_lux_h(self) -> tuple[float, ...]:
        return run_dose.lux_h_of_points(journal.read_events(self._run.journal_path))

    def proven(self) -> set[ShotId]:
        return set(self._proven)

    def has_room(self, view: str) -> bool:
        return self.has_room_for(view)

    def begin_view(self, start: ViewStart) -> None:
        self._refuse_moved()
        self._samples.begin(start.frame_format)
        path = self._run.view_path(start.view)
        allocated_bytes = (start.frames + SPARE_SLOTS) * start.frame_format.frame_bytes
        with under_way(DISK, str(path), allocated_bytes / _SLOWEST_ALLOCATION_BYTES_S):
            self._open_view(path, start)
            self._pose = self._view.add_pose(start.arm, start.base_from_camera)

    def _open_view(self, path: Path, start: ViewStart) -> None:
        self._file = str(path.relative_to(self._run.folder))
        if self._writer is None:
            view_slots = {str(shot): slot for shot, slot in self._proven.items() if shot.view == start.view}
            if not path.exists():
                if view_slots:
                    raise StorageError(f"{path}: the journal lists proven frames of it, but the file is missing")
                metadata = {**self._metadata, "title": start.view}
                create(
                    path,
                    start.frames + SPARE_SLOTS,
                    start.frame_format,
                    metadata,
                    {**self._described, **start.collections},
                    is_packed=self._packed,
                )
            self._writer = ViewWriter(path, view_slots)

    @property
    def _view(self) -> ViewWriter:
        assert self._writer is not None, "begin_view() comes before frames"
        return self._writer

    def store(self, frame: Frame, exposure_us: int) -> int:
        self._unsynced_bytes += frame.pixels.nbytes
        with under_way(DISK, self._file):
            slot = self._view.store(
                frame.pixels, frame_id=frame.frame_id, camera_ns=frame.timestamp_ns, exposure_us=exposure_us
            )
        self._samples.keep(slot, self._samples.of_frame(frame.pixels))
        return slot

    def sample_frames(self, *, is_wanted: bool) -> None:
        self._samples.is_wanted = is_wanted

    def sample(self, shot: ShotId) -> FrameSample:
        return self._samples.of_shot(shot, self._read_sample)

    def _read_sample(self, shot: ShotId) -> FrameSample:
        view, pixels = self._read_earlier(shot)
        return frame_sample(pixels, view.black_dn, view.white_dn)

    def earlier_pixels(self, shot: ShotId) -> NDArray[np.uint16]:
        return self._read_earlier(shot)[1]

    def _read_earlier(self, shot: ShotId) -> tuple[View, NDArray[np.uint16]]:
        """Read the frame from the file of an earlier session, checked against its journal."""
        if shot.view not in self._read_back:
            path = self._run.view_path(shot.view)
            frames = {s: frame for s, frame in self._run.proven().items() if s.view == shot.view}
            with under_way(DISK, str(path)):
                self._read_back = {shot.view: (read_view(path, list(frames.values())), frames)}
        view, frames = self._read_back[shot.view]
        with under_way(DISK, str(view.path)):
            return view, view.proven_pixels(frames[shot])

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        if shot in self._proven:
            raise StorageError(f"{self._file}: {shot} is already proven in slot {self._proven[shot]}")
        frame_id = self._view.frame_id(slot)
        digest = self._view.prove(slot, str(shot), pose=self._pose, **fields)
        self._proven[shot] = slot
        self._samples.prove(slot, shot)
        self._journal.write(
            FrameProven(shot=shot, file=self._file, index=slot, frame_id=frame_id, xxh3=f"{digest:016x}")
        )
        self._uncommitted.append(shot)

    def see_mark(self, slot: int, burst: Burst, step: int) -> None:
        """Keep nothing of the mark."""

    def free(self, slot: int) -> None:
        self._samples.free(slot)
        self._view.free(slot)

    def note(self, event: Event) -> None:
        self._journal.write(event)

    def note_at_once(self, event: Event) -> None:
        """Note an event from any thread. It is on the disk when this returns. Raises StorageError."""
        self._journal.append([event_line(event)])

    def keep_picture(self, name: str, content: bytes) -> str:
        folder = self._run.folder / PICTURES
        stem, suffix = name.rsplit(".", 1)
        path = folder / name
        with under_way(DISK, str(path)):
            number = 1
            while path.exists():
                number += 1
                path = folder / f"{stem}-{number}.{suffix}"
            try:
                make_folder(folder)
                write_synced(path, content)
            except OSError as error:
                raise disk_error(path, error) from error
        return str(path.relative_to(self._run.folder))

    def commit(self, *, now: bool) -> None:
        """Syncing a disk may take seconds. So another thread does it, unless it must be done `now`, and a running
        burst does not wait for the disk. The next call raises the errors of that thread."""
        if self._committing is not None and (now or self._committing.done()):
            committing, self._committing = self._committing, None
            committing.result()
        if now:
            self._commit_in_place(self._writer, *self._take_uncommitted())
        elif self._committing is None and time.monotonic() - self._committed_s > COMMIT_EVERY_S:
            self._committed_s = time.monotonic()
            self._committing = self._committer.submit(
                self._commit_in_place, self._writer, *self._take_uncommitted()
            )

    def _take_uncommitted(self) -> tuple[list[str], list[ShotId]]:
        """Return lines that are not written yet, and the shots that they prove."""
        shots, self._uncommitted = self._uncommitted, []
        return self._journal.take(), shots

    def _commit_in_place(self, writer: ViewWriter | None, lines: list[str], shots: list[ShotId]) -> None:
        """Write the lines. Then raise StorageError if the run's folder is no longer at its path, or if the view's
        file has changed."""
        self._commit(writer, lines, shots)
        self._refuse_moved()
        if writer is not None:
            path = self._run.folder / self._file
            try:
                with under_way(DISK, str(path)):
                    writer.refuse_lost(path)
            except StorageError:
                self._refuse_moved()  # just now
                raise

    def _refuse_moved(self) -> None:
        before = self._run.folder
        with under_way(DISK, str(before)):
            self._follow_folder()
            self._run.refuse_removed()
        if self._run.is_lost:
            raise StorageError(
                f"{before}: the run's folder or its journal was removed or replaced while frames were taken. "
                "Put the old files back, then resume the run; if they are lost, begin a new run."
            )
        if self._run.folder != before:
            raise StorageError(
                f"{before}: the run's folder was moved while frames were taken; it is {self._run.folder} now, "
                "with all proven frames. Resume it there."
            )

    def _follow_folder(self) -> None:
        """Tell the run where its folder is now, if the folder was moved. The open journal moves with it."""
        if not self._journal.is_at_its_path:
            place = self._journal.place
            self._run.is_lost = place is None
            self._run.folder = place.parent if place else self._run.folder

    def _commit(self, writer: ViewWriter | None, lines: list[str], shots: list[ShotId]) -> None:
        """Frames first, then the journal lines that refer to them."""
        with under_way(DISK, str(self._run.folder), self._unsynced_bytes / _SLOWEST_SYNC_BYTES_S):
            self._unsynced_bytes = 0
            if writer is not None:
                writer.sync()
            self._journal.append(lines)
        self.committed.update(shots)

    def refuse_lost(self) -> None:
        """Raise StorageError if the disk lacks lines of proven frames, files of views, or the description."""
        self._run.refuse_removed()
        proven_shots = self._run.proven()
        if lost_shots := self.committed - set(proven_shots):
            raise StorageError(
                f"{self._run.journal_path}: has lost the lines of {len(lost_shots)} proven frames. Restore it if "
                "there is a copy; or resume the run, which takes these frames again."
            )
        refuse_lost(self._run.folder, proven_shots.values())

    def end_view(self) -> None:
        self._samples.end()
        self._read_back.clear()
        if self._writer is not None:
            try:
                self.commit(now=True)
            finally:
                self._close_view()

    def _close_view(self) -> None:
        if self._writer is not None:
            with under_way(DISK, self._file):
                self._writer.close()
            self._writer = None

    def close_quietly(self) -> None:
        """Commit the last events if possible; a failure here must not hide the error that ended the run. A disk
        that hangs with frames may still take other lines; these are written."""
        lines, shots = self._take_uncommitted()
        try:
            if not hangs(DISK):
                run_bounded(lambda: self._commit_last(lines, shots))
                return
        except StorageError:
            pass
        other_lines = [line for line in lines if not line.startswith(FRAME_LINE)]
        with contextlib.suppress(StorageError):
            on_disk(
                str(self._run.journal_path), lambda: append_lines(self._run.journal_path, other_lines), stop=NOW
            )

    def _commit_last(self, lines: list[str], shots: list[ShotId]) -> None:
        if self._committing is not None:
            self._committing.result()
        self._commit(self._writer, lines, shots)
        self._follow_folder()

    def close(self) -> None:
        """Release everything; frames that were not committed remain unproven. Resources that a thread left behind
        may still use are not released."""
        if not left_behind():
            with contextlib.suppress(StorageError):
                run_bounded(self._close)

    def _close(self) -> None:
        self._committer.end()
        self._close_view()
        with under_way(DISK, str(self._run.journal_path)):
            self._journal.close()

"""Discards frames while a session goes on, when the processing beside it says that their samples are safe. The
discarder also tells whether there is room for the next view."""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import threading
from collections.abc import Callable

from rich.console import Console

from coupole.bounded import waited_for
from coupole.errors import DiskFull
from coupole.preflight.discard_room import DiscardRoom
from coupole.storage.discarding import discard, discarded_views
from coupole.storage.journal_events import FramesDiscarded
from coupole.storage.run import Run
from coupole.viewing.terminal import alarm, bytes_text

_ENDS_WITHIN_S = 20.0


class Discarder:
    """Discards frames of one session's run, whose lock the session holds."""

    def __init__(
        self, run: Run, note: Callable[[FramesDiscarded], None], room: DiscardRoom, console: Console
    ) -> None:
        """`note` writes an event to the journal on the disk; `room` is the room that each view needs."""
        self._run, self._note, self._room, self._console = run, note, room, console
        self._views = set(discarded_views(run))
        """Views that are discarded."""
        self._reasons: dict[str, str] = {}
        """Reasons why views keep their frames."""
        self._asked_count = self._done_count = 0
        self._asked: queue.SimpleQueue[FramesDiscarded | None] = queue.SimpleQueue()
        self._is_ending = False
        self._thread = threading.Thread(target=self._work, name="discarding", daemon=True)
        self._thread.start()

    def ask(self, event: FramesDiscarded) -> None:
        """Discard these frames soon, in a thread of its own."""
        self._asked_count += 1
        self._asked.put(event)

    def keep(self, view: str, why: str) -> None:
        """Keep the frames of a view."""
        self._reasons[view] = why
        self._console.print(f"reflectance: the frames of {view} are kept: {why}", markup=False)

    def end(self) -> None:
        """End after the present work. Requests that have not begun are done after the session."""
        self._is_ending = True
        self._asked.put(None)
        self._thread.join(_ENDS_WITHIN_S)

    def has_room(self, view: str, hope: Callable[[], str]) -> bool:
        """Tell whether the disk has room for a view that is about to begin, and for samples still to come. Returns
        False if there may be room when more frames are discarded. Raises DiskFull if no more frames will be
        discarded. `hope` returns the reason for this, or an empty text while frames may still be discarded."""
        if self._run.view_path(view).exists():
            return True
        needed_bytes = self._room.needed_bytes(view, self._waiting_views())
        free_bytes = shutil.disk_usage(self._run.folder).free
        if needed_bytes <= free_bytes:
            return True
        if self._done_count < self._asked_count or not (reason := hope()):
            return False
        kept_text = "".join(f"; the frames of {name} are kept: {why}" for name, why in self._reasons.items())
        raise DiskFull(
            f"{self._run.folder}: the view {view} needs {bytes_text(needed_bytes)}, {bytes_text(free_bytes)} are "
            f"free, and no more frames are discarded: {reason}{kept_text}. Free space on the disk, then resume "
            "the run: it continues with the remaining frames and with the samples"
        )

    def _waiting_views(self) -> set[str]:
        """Return views with a file whose samples may not be written yet."""
        return {path.stem for path in (self._run.folder / "views").glob("*.h5")} - self._views

    def _work(self) -> None:
        with contextlib.suppress(OSError):  # it must not take time from the frames
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)
        with waited_for():
            while (event := self._asked.get()) is not None and not self._is_ending:
                self._discard(event)
                self._done_count += 1

    def _discard(self, event: FramesDiscarded) -> None:
        if event.view in self._views:
            return
        try:
            discard(self._run, event, self._note)
        except Exception as error:  # noqa: BLE001  the acquisition goes on, and this thread
            self._reasons[event.view] = str(error)
            alarm(f"the frames of {event.view} are not discarded: {error}. The acquisition continues")
            return
        self._views.add(event.view)
        self._console.print(
            f"reflectance: {len(event.frames)} frames of {event.view} are discarded; their samples are safe",
            markup=False,
        )

"""The present run, followed by its journal: the proven frames of each view, the events, the newest frame."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path

from coupole.console.runs.event_words import words_of
from coupole.console.runs.run_files import RunFiles
from coupole.plan.shot_id import Led
from coupole.storage.journal import Follower
from coupole.storage.journal_events import (
    BurstEnded,
    BurstsChosen,
    FrameProven,
    ProcessingAsked,
    ReshootBegun,
    ViewChosen,
)
from coupole.storage.processing import Processing, processing_of
from coupole.storage.run import Run

_NO_OFTENER_S = 0.4
_EVENTS_KEPT = 200


@dataclass(frozen=True)
class Watched:
    """The progress of a run."""

    run: str
    views: tuple[tuple[str, int, int], ...]
    """Name, number of proven frames and number of expected frames of each view, in the plan's order."""
    newest: FrameProven | None
    """Newest proven frame under an LED."""
    reshot: int
    hottest_board_c: float | None
    events: tuple[tuple[str, str], ...]
    """Time (UTC) and words, the newest first."""
    processing: Processing | None
    """State of the processing during the run; None if it was not asked for."""


@dataclass
class _Followed:
    run: Run
    follower: Follower
    expected_counts: Counter[str]
    proven: Counter[str] = field(default_factory=Counter)
    newest: FrameProven | None = None
    reshot: int = 0
    hottest_board_c: float | None = None
    result: str = ""
    """Folder of the result that is made during the run."""
    events: deque[tuple[str, str]] = field(default_factory=lambda: deque(maxlen=_EVENTS_KEPT))

    def read_news(self) -> None:
        for event in self.follower.news():
            match event:
                case FrameProven():
                    self.proven[event.shot.view] += 1
                    if isinstance(event.shot.light, Led):
                        self.newest = event
                case ReshootBegun():
                    self.reshot += len(event.shots)
                case ProcessingAsked():
                    self.result = event.result
                case BurstsChosen():
                    self.expected_counts[event.view] += sum(len(list(burst.labels())) for burst in event.bursts)
                case ViewChosen() if event.view and not self.run.is_open:
                    shots = self.run.expected_shots()
                    self.expected_counts[event.view] = sum(shot.view == event.view for shot in shots)
                case BurstEnded():
                    self.hottest_board_c = event.hottest_board_c
                case _:
                    pass
            if words := words_of(event):
                self.events.appendleft((event.t, words))


class RunWatch:
    """One reader for all screens: its answer is kept for a moment, and only the first request after that waits."""

    def __init__(self, runs: RunFiles) -> None:
        self._runs, self._lock = runs, threading.Lock()
        self._followed: _Followed | None = None
        self._known: Watched | None = None
        self._read_s = 0.0

    def of(self, name: str) -> Watched:
        """Return the progress of a run of this cell. Raises InputError, StorageError."""
        with self._lock:
            followed_run = self._followed
            if followed_run is None or followed_run.run.folder.name != name:
                run = self._runs.run(name)
                shots_of_view = Counter(dict.fromkeys(run.views, 0) if run.is_open else {})
                if not run.is_open:  # otherwise frames are chosen in the run, and only its journal names them
                    shots_of_view.update(shot.view for shot in run.expected_shots())
                followed_run = self._followed = _Followed(run, Follower(run.journal_path), shots_of_view)
                self._read_s = 0.0
            if self._known is None or self._known.run != name or time.monotonic() - self._read_s > _NO_OFTENER_S:
                followed_run.read_news()
                self._known, self._read_s = _watched_run(followed_run), time.monotonic()
            return self._known


def _watched_run(followed_run: _Followed) -> Watched:
    run = followed_run.run
    processing = (
        processing_of(run.folder, Path(followed_run.result), frames_left=True, in_use=True)
        if followed_run.result
        else None
    )
    return Watched(
        run=followed_run.run.folder.name,
        views=tuple(
            (view, followed_run.proven[view], count) for view, count in followed_run.expected_counts.items()
        ),
        newest=followed_run.newest,
        reshot=followed_run.reshot,
        hottest_board_c=followed_run.hottest_board_c,
        events=tuple(followed_run.events),
        processing=processing,
    )

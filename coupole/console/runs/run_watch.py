"""The present run, followed by its journal: the proven frames of each view, the events, the newest frame."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from pathlib import Path

from coupole.console.runs.event_words import words_of
from coupole.console.runs.run_files import RunFiles
from coupole.errors import InputError
from coupole.plan.shot_id import Led
from coupole.storage.growing_pictures import Growing, read_growing
from coupole.storage.journal import Follower
from coupole.storage.journal_events import (
    BurstEnded,
    BurstsChosen,
    FrameProven,
    ProcessingAsked,
    ReshootBegun,
    ViewChosen,
)
from coupole.storage.processing import LOCK, PROGRESS, Processing, processing_of
from coupole.storage.run import Run
from coupole.storage.stopped_process import cpu_time_s, holder_of
from coupole.viewing.terminal import duration_text

_NO_OFTENER_S = 0.4
SILENT_S = 120.0
"""Time without a sign of life after which a message says so. A process with the lowest priority may wait for
long.
"""
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
    growing: Growing
    """Pictures and page of the views so far."""


@dataclass
class _SignsOfLife:
    """Signs of life of the process beside the run: its words and its CPU time."""

    signs: tuple[float, ...] = ()
    since_s: float = 0.0
    """Monotonic time at which these values were seen first."""

    def missing_s(self, result: Path) -> float:
        """Return the seconds since the newest sign; 0 if no process is at work."""
        pid, now_s = holder_of(result / LOCK), time.monotonic()
        if pid is None:
            self.signs = ()
            return 0.0
        try:
            told_s = (result / PROGRESS).stat().st_mtime
        except OSError:
            told_s = 0.0
        signs = float(pid), told_s, cpu_time_s(pid)
        if signs != self.signs:
            self.signs, self.since_s = signs, now_s
        return now_s - self.since_s


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
    life: _SignsOfLife = field(default_factory=_SignsOfLife)
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

    def result_of(self, name: str) -> Path:
        """Return the folder of the result that is made beside a run's acquisition. Raises InputError if there is
        none, or no such run; StorageError."""
        run, followed_run = self._runs.run(name), self._followed
        if followed_run is not None and followed_run.run.folder.name == name and followed_run.result:
            return Path(followed_run.result)
        if (result := run.asked_result) is None:
            raise InputError(f"{name}: this run is not processed during its acquisition")
        return result

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
    result = Path(followed_run.result) if followed_run.result else None
    return Watched(
        run=followed_run.run.folder.name,
        views=tuple(
            (view, followed_run.proven[view], count) for view, count in followed_run.expected_counts.items()
        ),
        newest=followed_run.newest,
        reshot=followed_run.reshot,
        hottest_board_c=followed_run.hottest_board_c,
        events=tuple(followed_run.events),
        processing=None if result is None else _processing(followed_run, result),
        growing=Growing() if result is None else read_growing(result),
    )


def _processing(followed_run: _Followed, result: Path) -> Processing:
    """Return the state of the processing; `why` also says if its process shows no sign of life."""
    processing = processing_of(followed_run.run.folder, result, frames_left=True, in_use=True)
    missing_s = followed_run.life.missing_s(result)
    if processing.is_at_work and not processing.why and missing_s > SILENT_S:
        pid = holder_of(result / LOCK)
        why = (
            f"its process {pid} reported nothing and computed nothing for {duration_text(missing_s)}: it hangs, "
            f"or other work leaves it no processor. The run goes on; `kill {pid}` ends this process alone"
        )
        return replace(processing, why=why)
    return processing

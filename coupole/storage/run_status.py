"""Progress of a run and the history of its sessions, from its journal and its lock."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, assert_never

from coupole.errors import CoupoleError
from coupole.plan.shot_id import Sentinel
from coupole.storage import journal, run_dose
from coupole.storage.durable import sha256
from coupole.storage.journal_events import (
    ArmSettled,
    BurstBegun,
    BurstEnded,
    BurstsChosen,
    Continued,
    Event,
    FaultNoted,
    FindingNoted,
    FrameProven,
    FramesDiscarded,
    GapFound,
    InputsChanged,
    JournalBegun,
    MoveBegun,
    Paused,
    ProcessingAsked,
    ReshootBegun,
    SessionResumed,
    SessionStarted,
    SessionStopped,
    TextUnread,
    ViewBegun,
    ViewChosen,
    ViewSealed,
)
from coupole.storage.processing import Processing, processing_of
from coupole.storage.run import Run
from coupole.storage.run_json import RUN_JSON
from coupole.storage.stopped_process import is_stopped

RUNNING, PAUSED, CREATED = "running", "paused", "created"
KILLED = "its last session has no end: it was killed, or the power failed"
_STOPPED_IN_0_1 = "Interrupted"
"""Kind of fault with which version 0.1 noted that the operator had stopped the session."""


@dataclass
class Session:
    """One session of a run. Times are UTC, ISO 8601."""

    begun: str
    ended: str = ""
    """Time of its last event so far."""
    outcome: str = ""
    """`done`, `interrupted` or `failed`; empty while it runs, and for a killed session."""
    reason: str = ""
    """Reason why it ended before all was done."""
    pauses: int = 0
    paused_s: float = 0.0
    light_s: float = 0.0
    """Sum of the on-times of its LEDs."""
    took_s: float | None = None
    """Duration by a clock that nobody sets, s; None while it runs, and for a killed session."""

    @property
    def duration_s(self) -> float:
        """Time from its begin to its last event, s. Pauses are included."""
        return _seconds(self.begun, self.ended) if self.took_s is None else self.took_s

    @property
    def clock_set_s(self) -> float:
        """Time by which the machine's clock was set in the session, s; 0 if that is not known."""
        return 0.0 if self.took_s is None else _difference_s(self.begun, self.ended) - self.took_s


@dataclass
class Status:
    """Progress of a run."""

    state: str = CREATED
    """`created`, `running`, `paused`, `done`, `interrupted` (by a person, a signal, a crash) or `failed`."""
    reason: str = ""
    """Reason why it is interrupted or failed."""
    proof: str = ""
    """Kind of proof of its frames."""
    shots: int = 0
    proven: int = 0
    darks_proven: int = 0
    reshot: int = 0
    faults: list[str] = field(default_factory=list)
    """Failures of the run. A stop by a person is not a failure."""
    holds: list[str] = field(default_factory=list)
    """Reason of each hold until a person let the session go on, such as Ctrl-Z or a freeze."""
    findings: list[str] = field(default_factory=list)
    """Findings of watching the measurement: view, name, description, and the picture's path in the run."""
    sessions: list[Session] = field(default_factory=list)
    views: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Proven and expected frames of each view. If frames are chosen in the run, the expected ones are those chosen
    so far."""
    open_views: list[str] = field(default_factory=list)
    """Views for which more frames may still be chosen, if frames are chosen in the run."""
    most_views: int | None = None
    """Greatest number of views, if views are chosen in the run; None if the plan gives them."""
    wants_views: bool = False
    """True if more views may still be chosen."""
    why_enough_views: str = ""
    """Reason why no more views are chosen; empty if more may be chosen, or if the plan gives the views."""
    last_event: str = ""
    dose_lux_h: float = 0.0
    """Light on the object in all sessions."""
    dose_budget_lux_h: float | None = None
    """Light that the object may receive in its life, at the begin of the last session; None: no budget, or not
    known."""
    stopped_pid: int | None = None
    """The process that uses the run, if it is stopped (Ctrl-Z, SIGSTOP); otherwise None."""
    go_on: str = ""
    """The command line that takes the remaining frames; empty if there are none, or while the run is in use."""
    before_that: str = ""
    """The command line with which a person first confirms a fault of the arm; empty if there is no fault."""
    frames_discarded: int = 0
    """Frames that were discarded when their samples were safe, as the plan said."""
    processing: Processing | None = None
    """Processing beside the acquisition; None if it was not requested."""

    @property
    def missing(self) -> int:
        return self.shots - self.proven

    @property
    def frames_left(self) -> int:
        """Shots and dark frames that are not proven."""
        return sum(shots - proven for proven, shots in self.views.values())

    @property
    def left_in_words(self) -> str:
        """Return in words how much is left to take. If bursts or views are chosen in the run, the rest is not
        known."""
        frames = "1 frame" if self.frames_left == 1 else f"{self.frames_left} frames"
        if self.wants_views:
            return f"{frames} and views that are not chosen yet"
        return f"{frames} and frames that are not chosen yet" if self.open_views else frames

    @property
    def has_left(self) -> bool:
        """True if frames are left to take, or may be left because the choice has not ended."""
        return bool(self.frames_left or self.open_views or self.wants_views)

    @property
    def views_in_words(self) -> str:
        """Return in words how many views were chosen, and why no more are. It is empty if the plan gives the
        views."""
        if self.most_views is None:
            return ""
        return f"{len(self.views)} of at most {self.most_views} views" + (
            f"; {self.why_enough_views}" if self.why_enough_views else " so far"
        )

    def figures(self) -> dict[str, Any]:
        """Content of `--json`."""
        sessions = [{**vars(session), "duration_s": round(session.duration_s, 3)} for session in self.sessions]
        processing = None if self.processing is None else self.processing.figures()
        left = {"missing": self.missing, "frames_left": self.frames_left}
        return {**vars(self), "sessions": sessions, "processing": processing, **left}


def status(run: Run, *, in_use: bool | None = None) -> Status:
    """Return the progress of a run, even while it is running. A caller that knows about the run's lock may say
    whether the run is `in_use`.
    """
    status = Status(proof=run.proof)
    shots = list(run.expected_shots())
    status.shots = sum(shot.is_shot for shot in shots)
    per_view = Counter(shot.view for shot in shots)
    in_use = run.in_use if in_use is None else in_use
    proven = set()
    events = list(journal.read_events(run.journal_path))
    status.dose_lux_h = run_dose.highest_lux_h(events)
    result = ""
    for event in events:
        if isinstance(event, FrameProven):
            proven.add(event.shot)
        elif isinstance(event, ProcessingAsked):
            result = event.result
        _note_event(status, event)
    status.frames_discarded = sum(len(event.frames) for event in events if isinstance(event, FramesDiscarded))
    status.proven = sum(shot.is_shot for shot in proven)
    status.darks_proven = sum(not shot.is_shot and not isinstance(shot.light, Sentinel) for shot in proven)
    proven_per_view = Counter(shot.view for shot in proven)
    status.open_views = run.open_views()
    status.most_views, status.wants_views = run.most_views, run.wants_views
    status.views = {
        view: (proven_per_view[view], count)
        for view, count in (dict.fromkeys(status.open_views, 0) | per_view).items()
    }
    if in_use and status.state == CREATED:
        status.state = RUNNING
    if not in_use and status.state in (RUNNING, PAUSED):
        status.state, status.reason = "interrupted", KILLED
    holder = run.holder if in_use else None
    status.stopped_pid = holder if holder and is_stopped(holder) else None
    if status.has_left and not in_use:
        status.go_on = run.go_on_command
        if status.faults or status.holds:
            status.before_that = _confirmation(run)
    if result:
        frames_left = status.has_left
        discards = [event for event in events if isinstance(event, FramesDiscarded)]
        place = _place_of_samples(run, discards) or Path(result)
        processing = processing_of(run.folder, place, frames_left=frames_left, in_use=in_use)
        status.processing = _with_samples(processing, place, discards)
    return status


def _place_of_samples(run: Run, discards: Sequence[FramesDiscarded]) -> Path | None:
    """Return the folder of the result whose samples replace discarded frames; None if no frames were discarded."""
    if not discards:
        return None
    from coupole.storage.discarding import place_of_result

    return place_of_result(run, discards[-1])


def _with_samples(processing: Processing, place: Path, discards: Sequence[FramesDiscarded]) -> Processing:
    """Return the processing. It is failed if samples that replace discarded frames are missing."""
    missing = [place / event.samples for event in discards if not (place / event.samples).exists()]
    if not missing:
        return processing
    why = f"{missing[0]} is missing: put it back from a copy; nothing else has these samples"
    return Processing(processing.result, "failed", processing.views_done, processing.views, why=why)


def _confirmation(run: Run) -> str:
    """Return the command that confirms the standing faults of the rig's arm. It is empty if there are none, or if
    the rig's file is not where it was at the run's begin."""
    from coupole.plan.cell import read_cell
    from coupole.storage.arm_faults import faults_of

    with contextlib.suppress(CoupoleError):
        cell = read_cell(Path(run.about["rig"]["path"]))
        if faults_of(cell).standing():
            return f"coupole confirm {cell.document.path} --name NAME"
    return ""


def _note_event(found: Status, event: Event) -> None:
    before, found.last_event = found.last_event, event.t
    session = found.sessions[-1] if found.sessions else Session(begun=event.t)
    match event:
        case SessionStarted() | SessionResumed():
            found.state, found.reason = RUNNING, ""
            found.dose_budget_lux_h = event.dose_budget_lux_h
            session = Session(begun=event.t)
            found.sessions.append(session)
        case Continued():
            found.state = RUNNING
            found.reason = "" if found.reason in found.holds else found.reason
            session.paused_s += _seconds(before, event.t)
        case Paused():
            found.state = PAUSED
            session.pauses += 1
        case SessionStopped():
            found.state, found.reason = event.outcome, event.reason or found.reason
            session.outcome, session.reason, session.took_s = event.outcome, found.reason, event.took_s
        case ReshootBegun():
            found.reshot += len(event.shots)
        case FaultNoted():
            _note_fault(found, event)
        case FindingNoted():
            picture = f" ({event.picture})" if event.picture else ""
            found.findings.append(f"{event.view}: {event.kind}: {event.message}{picture}")
        case BurstEnded():
            session.light_s += event.on_s
        case ViewChosen():
            found.why_enough_views = "" if event.view else event.reason
        case (
            JournalBegun() | ProcessingAsked() | ViewBegun() | MoveBegun() | ArmSettled() | FrameProven()
            | BurstsChosen() | BurstBegun() | GapFound() | ViewSealed() | InputsChanged() | TextUnread()
            | FramesDiscarded()
        ):  # fmt: skip
            pass
        case _:
            assert_never(event)
    if not isinstance(event, FramesDiscarded):  # perhaps after the session
        session.ended = event.t


def _note_fault(status: Status, event: FaultNoted) -> None:
    status.reason = event.message
    if event.is_hold:
        status.holds.append(event.message)
    elif event.kind != _STOPPED_IN_0_1:
        status.faults.append(event.message)


def _seconds(begin_time: str, end_time: str) -> float:
    """Time between two events, not below 0: the machine's clock may have been set meanwhile."""
    return max(0.0, _difference_s(begin_time, end_time))


def _difference_s(begin_time: str, end_time: str) -> float:
    if not begin_time or not end_time:
        return 0.0
    return (datetime.fromisoformat(end_time) - datetime.fromisoformat(begin_time)).total_seconds()


def newest_run(parent: Path, name: str, plan: Path, say: Callable[[str], object]) -> Path | None:
    """Return the newest run in `parent` of the plan with this name. None if there is no such run, or if the plan's
    file has changed since the run began; this is then passed to `say`."""
    folders = [folder for folder in sorted(parent.glob(f"*-{name}")) if (folder / RUN_JSON).is_file()]
    if not folders:
        return None
    if Run(folders[-1]).about["plan"]["sha256"] != sha256(plan):
        say(f"{plan} was changed since {folders[-1].name}: a new run is acquired")
        return None
    return folders[-1]


def is_complete(folder: Path) -> bool:
    """Tell whether all frames of a run are proven, and no more are to be chosen."""
    found = status(Run(folder))
    return not found.has_left

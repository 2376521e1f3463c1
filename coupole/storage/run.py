"""A run folder: create, open, status, verify.

::

    RUN/
      run.json        the request, operator and software; plan, rig and other files with their SHA-256
      journal.jsonl   one line per event; a `frame` line for each proven shot
      views/NAME.h5   frames
      report.html     report with pictures
"""

from __future__ import annotations

import fcntl
import getpass
import hashlib
import json
import os
import platform
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, assert_never

import coupole
from coupole.errors import InputError, StorageError
from coupole.plan.shot_id import Led, ShotId, ShotLabel
from coupole.storage import frame_file, journal, run_dose
from coupole.storage.journal_events import (
    JOURNAL_VERSION,
    ArmSettled,
    BurstBegun,
    BurstEnded,
    Continued,
    Event,
    FaultNoted,
    FrameProven,
    GapFound,
    JournalBegun,
    MoveBegun,
    Paused,
    ReshootBegun,
    SessionResumed,
    SessionStarted,
    SessionStopped,
    ViewBegun,
    ViewSealed,
)
from coupole.storage.line_file import utc_now

SCHEMA_VERSION = 1


def sha256(path: Path) -> str:
    """Hex digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class Inputs:
    """Files that a run depends on; a run can be resumed only with unchanged ones."""

    plan: Path
    rig: Path
    others: tuple[Path, ...]

    def describe(self) -> dict[str, Any]:
        def one(path: Path) -> dict[str, str]:
            return {"path": str(path), "sha256": sha256(path)}

        return {
            "plan": {**one(self.plan), "text": self.plan.read_text(encoding="utf-8")},
            "rig": {**one(self.rig), "text": self.rig.read_text(encoding="utf-8")},
            "files": [one(path) for path in self.others],
        }


class Run:
    """An open run folder."""

    def __init__(self, folder: Path) -> None:
        """Open an existing run. Raises InputError if there is none."""
        self.folder = folder.resolve()
        try:
            self.about: dict[str, Any] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        except (OSError, json.JSONDecodeError) as error:
            raise InputError(f"{folder}: not a run folder: {error}") from error
        if self.about.get("schema_version") != SCHEMA_VERSION:
            raise InputError(
                f"{folder}: expected run.json of schema version {SCHEMA_VERSION}, "
                f"found {self.about.get('schema_version')}"
            )

    @staticmethod
    def create(parent: Path, name: str, inputs: Inputs, about: dict[str, Any]) -> Run:
        """Make `<UTC time>-<name>` under `parent`."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        try:
            parent.mkdir(parents=True, exist_ok=True)
            folder = _new_folder(parent, f"{stamp}-{name}")
            (folder / "views").mkdir()
            described = {
                "schema_version": SCHEMA_VERSION,
                "software": {"name": "coupole", "version": coupole.__version__},
                "created": utc_now(),
                "host": platform.node(),
                "operator": _user(),
                **about,
                **inputs.describe(),
            }
            text = json.dumps(described, indent=2, ensure_ascii=False)
            _write_synced(folder / "run.json", text)
        except OSError as error:
            raise StorageError(f"{parent}: cannot make a run folder: {error.strerror}") from error
        return Run(folder)

    @property
    def created(self) -> datetime:
        return datetime.fromisoformat(self.about["created"])

    @property
    def journal_path(self) -> Path:
        return self.folder / "journal.jsonl"

    def view_path(self, view: str) -> Path:
        return self.folder / "views" / f"{view}.h5"

    def allocated_bytes(self) -> int:
        """Disk space that views already occupy: files are allocated completely before their first frame, or
        archived."""
        return sum(map(_settled_bytes, (self.folder / "views").glob("*.h5")))

    def expected_shots(self) -> Iterable[ShotId]:
        """All shots and dark frames of the plan, without those whose LEDs are occluded in their view."""
        labels: list[str] | dict[str, list[str]] = self.about["labels"]
        for view in self.about["views"]:
            hidden = set(map(Led, self.hidden_leds.get(view, ())))
            for text in labels[view] if isinstance(labels, dict) else labels:
                if (label := ShotLabel.parse(text)).light not in hidden:
                    yield ShotId(view, label)

    @property
    def hidden_leds(self) -> dict[str, list[int]]:
        """LEDs that were left out of views, by name of view, because arm, camera or object occlude them."""
        found: dict[str, list[int]] = self.about.get("hidden_leds", {})
        return found

    @property
    def proof(self) -> str:
        """What the identity of the run's frames rests on, in the words of run.json."""
        found: str = self.about.get("proof", "not recorded")
        return found

    def proven(self) -> dict[ShotId, FrameProven]:
        """Proven shots, by the journal."""
        return {event.shot: event for event in journal.read(self.journal_path) if isinstance(event, FrameProven)}

    def robot_fault(self) -> str:
        """The fault of the arm that ended the last session; empty if there was none."""
        found = ""
        for event in journal.read(self.journal_path):
            if isinstance(event, SessionStarted | SessionResumed):
                found = ""
            elif isinstance(event, FaultNoted) and event.device == "robot":
                found = event.message
        return found

    def lock(self) -> int:
        """Lock the run for this process. Raises InputError if another process acquires into it."""
        fd = os.open(self.folder / "run.json", os.O_RDONLY)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(fd)
            raise InputError(f"{self.folder}: another process is acquiring into this run") from error
        return fd

    def refuse_old_journal(self) -> None:
        """Raise InputError if the journal has an old version, which can be read but not continued."""
        if (found := journal.version(self.journal_path)) != JOURNAL_VERSION:
            raise InputError(
                f"{self.folder}: begun by coupole {self.about['software']['version']}, whose journal (version "
                f"{found}) cannot be continued: it cannot be resumed. It can be verified, exported, archived "
                "and used for calibrations; acquire its missing frames in a new run."
            )

    def refuse_changes(self, inputs: Inputs) -> None:
        """Raise InputError unless plan, rig and the files they name are those that the run began with."""
        now = inputs.describe()
        changed = [
            f"{what} ({now[what]['path']})"
            for what in ("plan", "rig")
            if now[what]["sha256"] != self.about[what]["sha256"]
        ]
        before = Counter(entry["sha256"] for entry in self.about["files"])
        changed += [entry["path"] for entry in now["files"] if not before[entry["sha256"]]]
        if changed:
            raise InputError(
                f"{self.folder}: cannot be resumed: {', '.join(changed)} changed since the run began. "
                "Put the old file back, or start a new run."
            )


def _new_folder(parent: Path, name: str) -> Path:
    for attempt in range(1000):
        folder = parent / (f"{name}-{attempt + 1}" if attempt else name)
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise StorageError(f"{parent}: a thousand runs named {name} exist already")


def _settled_bytes(view_file: Path) -> int:
    layout = frame_file.read_layout(view_file)
    return layout.frames * layout.frame_bytes if layout.archived else view_file.stat().st_blocks * 512


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def _write_synced(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


@dataclass
class Status:
    """Progress of a run, by its journal alone."""

    state: str = "created"
    proof: str = ""
    """What the identity of its frames rests on."""
    shots: int = 0
    proven: int = 0
    darks_proven: int = 0
    reshot: int = 0
    faults: list[str] = field(default_factory=list)
    views: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Proven and expected frames of each view."""
    last_event: str = ""
    dose_lux_h: float = 0.0
    """Light on the object in all sessions."""

    @property
    def missing(self) -> int:
        return self.shots - self.proven


def status(run: Run) -> Status:
    """Progress of a run, also of one that is running."""
    found = Status(proof=run.proof)
    expected = list(run.expected_shots())
    found.shots = sum(shot.is_shot for shot in expected)
    per_view = Counter(shot.view for shot in expected)
    proven = set(run.proven())
    found.proven = sum(shot.is_shot for shot in proven)
    found.darks_proven = len(proven) - found.proven
    proven_per_view = Counter(shot.view for shot in proven)
    found.views = {view: (proven_per_view[view], count) for view, count in per_view.items()}
    for event in journal.read(run.journal_path):
        _note_event(found, event)
    found.dose_lux_h = run_dose.highest_lux_h(journal.read(run.journal_path))
    return found


def _note_event(found: Status, event: Event) -> None:
    found.last_event = event.t
    match event:
        case SessionStarted() | SessionResumed() | Continued():
            found.state = "running or interrupted"
        case Paused():
            found.state = "paused"
        case SessionStopped():
            found.state = event.outcome
        case ReshootBegun():
            found.reshot += len(event.shots)
        case FaultNoted():
            found.faults.append(event.message)
        case JournalBegun() | ViewBegun() | MoveBegun() | ArmSettled() | FrameProven():
            pass
        case BurstBegun() | BurstEnded() | GapFound() | ViewSealed():
            pass
        case _:
            assert_never(event)


@dataclass
class Verification:
    """Result of `verify`."""

    frames: int = 0
    bad: list[str] = field(default_factory=list)
    """One line for each error."""
    missing: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.bad and not self.missing


def verify(run: Run, progress: Callable[[int, int], None] = lambda done, total: None) -> Verification:
    """Read every proven frame back: each shot of the plan exactly once, each record and checksum right."""
    result = Verification()
    proven = run.proven()
    result.missing = [str(shot) for shot in run.expected_shots() if shot not in proven]
    by_file: dict[str, list[FrameProven]] = {}
    for frame in proven.values():
        by_file.setdefault(frame.file, []).append(frame)
    lines = Counter(event.shot for event in journal.read(run.journal_path) if isinstance(event, FrameProven))
    result.bad += [f"{shot}: proven {n} times in the journal" for shot, n in lines.items() if n > 1]
    done = 0
    for name, frames in sorted(by_file.items()):
        path = run.folder / name
        try:
            layout, table = frame_file.read_layout(path), frame_file.read_frames(path)
        except StorageError as error:
            result.bad.append(str(error))
            continue
        claimed = Counter(record["shot"] for record in table if record["state"] == frame_file.PROVEN)
        result.bad += [f"{name}: {shot.decode()} is in {n} slots" for shot, n in claimed.items() if n > 1]
        for frame in sorted(frames, key=lambda f: f.index):
            if problem := _frame_problem(path, layout, table, frame):
                result.bad.append(problem)
            result.frames += 1
            done += 1
            progress(done, len(proven))
    return result


def _frame_problem(path: Path, layout: frame_file.Layout, table: Any, frame: FrameProven) -> str:
    if not 0 <= frame.index < layout.frames:
        return f"{frame.shot}: slot {frame.index} is not in {path.name}"
    record = table[frame.index]
    if record["state"] != frame_file.PROVEN or record["shot"].decode() != str(frame.shot):
        return f"{frame.shot}: slot {frame.index} of {path.name} is recorded as `{record['shot'].decode()}`"
    try:
        found = frame_file.checksum(frame_file.read_frame(path, layout, frame.index))
    except StorageError as error:
        return f"{frame.shot}: {error}"
    if not f"{found:016x}" == f"{int(record['xxh3']):016x}" == frame.xxh3:
        return f"{frame.shot}: slot {frame.index} of {path.name} has checksum {found:016x}, not {frame.xxh3}"
    return ""

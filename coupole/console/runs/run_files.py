"""The runs of a cell for its console, read from their folders alone."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from coupole.errors import CoupoleError, InputError, StorageError
from coupole.plan.shot_id import Led, ShotId
from coupole.storage import frame_file, journal
from coupole.storage.journal import Follower
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.run_json import RUN_JSON
from coupole.storage.run_status import Status, status
from coupole.storage.view_reader import View, read_view
from coupole.viewing.raw_preview import Coding, Figures, figures, look

PICTURE_WIDTHS = (160, 320, 640, 1280, 2048)
_PICTURES_KEPT = 600
_RUNS_FOLLOWED = 4


@dataclass(frozen=True)
class RunRow:
    """A run in a table."""

    name: str
    state: str
    """State of the run, as in `run_status.Status.state`, or `damaged`."""
    object: str
    created: str
    operator: str
    simulated: bool
    proven: int
    frames: int
    bytes: int
    archived: bool
    """True if all views are compressed."""
    verified: str
    """Time, UTC, when the run was last verified without a fault; empty if never, or if it has changed since."""
    thumbnail: str
    """A shot for the thumbnail; empty without one."""


@dataclass(frozen=True)
class Frame:
    """One frame and its figures."""

    shot: str
    exposure_us: int
    led: int
    frame_id: int
    t_trigger_ns: int
    board_c: float
    current_ma: int
    joints_deg: tuple[float, ...]
    figures: Figures
    coding: Coding


class _Followed:
    """The proven frames of one run; only new lines of its journal are read."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._follower, self._proven = Follower(self._path), dict[ShotId, FrameProven]()
        self._inode = self._size = 0

    def event(self, shot: ShotId) -> FrameProven | None:
        """Return the event of a proven shot. Raises StorageError."""
        with self._lock:
            self._read_news()
            return self._proven.get(shot)

    def proven_frames(self) -> dict[ShotId, FrameProven]:
        """Return the events of all proven frames. Raises StorageError."""
        with self._lock:
            self._read_news()
            return dict(self._proven)

    def _read_news(self) -> None:
        try:
            about = self._path.stat()
        except OSError:
            self._begin()
            return
        if about.st_ino != self._inode or about.st_size < self._size:
            self._begin()
        try:
            news = self._follower.news()
        except StorageError:
            self._begin()
            raise
        self._proven |= {event.shot: event for event in news if isinstance(event, FrameProven)}
        self._inode, self._size = about.st_ino, about.st_size


class RunFiles:
    """Runs in a cell's storage folder, by the names of their folders."""

    def __init__(self, folder: Path, notes: Path) -> None:
        """`notes`: folder for notes about runs, such as when they were verified."""
        self.folder, self._notes, self._lock = folder, notes, threading.Lock()
        self._rows: dict[str, tuple[str, RunRow]] = {}
        self._followed: OrderedDict[str, _Followed] = OrderedDict()
        self._pictures = functools.lru_cache(_PICTURES_KEPT)(self._picture)

    def names(self) -> list[str]:
        """Return the names of all runs, the newest first."""
        if not self.folder.is_dir():
            return []
        names = [path.parent.name for path in self.folder.glob(f"*/{RUN_JSON}")]
        return sorted(names, reverse=True)

    def run(self, name: str) -> Run:
        """Return a run. Raises InputError if no run of this cell has this name."""
        if not name or "/" in name or name.startswith(".") or not (self.folder / name / RUN_JSON).is_file():
            raise InputError(f"{name!r}: no run of this cell")
        return Run(self.folder / name)

    def rows(self) -> list[RunRow]:
        """Return the rows of all runs; a run is read again only if it has changed."""
        return [self.row(name) for name in self.names()]

    def status(self, name: str) -> Status:
        """Return the progress of a run. Raises InputError, StorageError."""
        return status(self.run(name))

    def proven(self, name: str) -> dict[ShotId, FrameProven]:
        """Return the events of a run's proven frames. Raises InputError, StorageError."""
        return self._follow(name).proven_frames()

    def _follow(self, name: str) -> _Followed:
        """Return the followed run; those that were asked for last are kept."""
        path = self.run(name).journal_path
        with self._lock:
            follower = self._followed.setdefault(name, _Followed(path))
            self._followed.move_to_end(name)
            while len(self._followed) > _RUNS_FOLLOWED:
                self._followed.popitem(last=False)
        return follower

    def view(self, name: str, events: Sequence[FrameProven]) -> View:
        """Return the file with these frames of one view. Raises InputError, StorageError."""
        path = self.run(name).folder / events[0].file
        if not path.is_file():
            raise StorageError(f"{path}: no such file")
        return read_view(path, events)

    def picture(self, name: str, shot: str, width_px: int, *, saturation: bool = False) -> bytes:
        """Return a JPEG of a proven shot, at most `width_px` wide (rounded up to one of PICTURE_WIDTHS). Raises
        InputError, StorageError."""
        width_px = next((width for width in PICTURE_WIDTHS if width >= width_px), PICTURE_WIDTHS[-1])
        event = self._event(name, shot)
        return self._pictures(name, shot, event.xxh3, width_px, saturation)

    def frame(self, name: str, shot: str) -> Frame:
        """Return the figures of one frame. Raises InputError, StorageError."""
        event = self._event(name, shot)
        view = self.view(name, [event])
        record = view.records[event.index]
        coding = Coding(view.pattern, view.black_dn, view.white_dn)
        pose = view.poses[record["pose"]] if len(view.poses) else None
        return Frame(
            shot=shot,
            exposure_us=int(record["exposure_us"]),
            led=int(record["led"]),
            frame_id=int(record["frame_id"]),
            t_trigger_ns=int(record["t_trigger_ns"]),
            board_c=int(record["board_temperature_dc"]) / 10,
            current_ma=int(record["led_current_ma"]),
            joints_deg=() if pose is None else tuple(float(angle) for angle in pose["joints_deg"]),
            figures=figures(view.pixels(event.index), coding),
            coding=coding,
        )

    def fingerprint(self, name: str) -> str:
        """Return a checksum of names, sizes and times of all files in a run's folder. It changes if a file is
        written, added or removed."""
        folder = self.folder / name
        checksum = hashlib.sha256()
        for path in sorted(folder.rglob("*")):
            try:
                about = path.stat()
            except OSError:  # the file was removed meanwhile
                continue
            if not path.is_dir():
                checksum.update(f"{path.relative_to(folder)}\0{about.st_size}\0{about.st_mtime_ns}\0".encode())
        return checksum.hexdigest()

    def note_verified(self, name: str, t: str, before: str) -> None:
        """Note that a run was verified at `t` without a fault. Nothing is noted if its `fingerprint` differs from
        `before`, the one before the verification."""
        if self.fingerprint(name) == before:
            self._notes.mkdir(parents=True, exist_ok=True)
            (self._notes / name).write_text(f"{t} {before}", encoding="utf-8")

    def _verified_at(self, name: str, fingerprint: str) -> str:
        try:
            t, noted_fingerprint = (self._notes / name).read_text(encoding="utf-8").split()
        except (OSError, ValueError):
            return ""
        return t if noted_fingerprint == fingerprint else ""

    def row(self, name: str) -> RunRow:
        """Return the row of one run."""
        fingerprint = self.fingerprint(name)
        known_fingerprint, row = self._rows.get(name, ("", None))
        if row is None or known_fingerprint != fingerprint or row.state in ("running", "paused", "created"):
            row = self._read_row(name)
            self._rows[name] = fingerprint, row
        verified_at = self._verified_at(name, fingerprint)
        return row if verified_at == row.verified else RunRow(**{**vars(row), "verified": verified_at})

    def _read_row(self, name: str) -> RunRow:
        try:
            run = self.run(name)
            run_status = status(run)
            proven = sum(count for count, _ in run_status.views.values())
            thumbnail = _typical(run) if proven else ""
            is_archived = bool(proven) and all(
                frame_file.read_layout(run.view_path(view)).is_archived for view in run.views
            )
        except (CoupoleError, KeyError, OSError) as error:
            return RunRow(name, "damaged", "", "", str(error), False, 0, 0, 0, False, "", "")
        views = (run.folder / "views").glob("*.h5")
        return RunRow(
            name=name,
            state=run_status.state,
            object=run.about.get("object") or "",
            created=run.about["created"],
            operator=str(run.about.get("operator", "")),
            simulated=run.is_simulated,
            proven=proven,
            frames=sum(count for _, count in run_status.views.values()),
            bytes=sum(path.stat().st_blocks * 512 for path in views),
            archived=is_archived,
            verified="",
            thumbnail=thumbnail,
        )

    def _event(self, name: str, shot: str) -> FrameProven:
        try:
            shot_id = ShotId.parse(shot)
        except ValueError as error:
            raise InputError(f"{shot!r}: expected a shot such as top/led0417/e0") from error
        event = self._follow(name).event(shot_id)
        if event is None:
            raise InputError(f"{shot}: not proven in {name}")
        return event

    def _picture(self, name: str, shot: str, _: str, width_px: int, saturation: bool) -> bytes:
        event = self._event(name, shot)
        view = self.view(name, [event])
        coding = Coding(view.pattern, view.black_dn, view.white_dn)
        return look(view.pixels(event.index), coding, width_px, saturation=saturation, focus=False)


def _typical(run: Run) -> str:
    """Return a proven shot with light from the middle of a run's first view; empty without one."""
    lit: list[ShotId] = []
    for event in journal.read_events(run.journal_path):
        if isinstance(event, FrameProven) and event.shot.is_shot and isinstance(event.shot.light, Led):
            if lit and event.shot.view != lit[0].view:
                break
            lit.append(event.shot)
    return str(lit[len(lit) // 2]) if lit else ""

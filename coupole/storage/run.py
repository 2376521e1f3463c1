"""A run folder: create, open, lock.

::

    RUN/
      run.json          the request, operator and software; plan, rig and other files with their SHA-256
      inputs/           copies of these files
      journal.jsonl     one line per event; a `frame` line for each proven shot
      views/NAME.h5     frames
      report.html       report with pictures
      README.txt        what this folder is, for readers without Coupole
      manifest.sha256   checksums of the files
"""

from __future__ import annotations

import fcntl
import getpass
import json
import os
import platform
import shlex
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import coupole
from coupole.errors import InputError, StorageError
from coupole.plan.choices import Choice, has_enough
from coupole.plan.shot_id import Led, ShotId, ShotLabel
from coupole.plan.view_choices import ChosenView, has_enough_views
from coupole.storage import journal, manifest
from coupole.storage.durable import make_folder, sync_folder, write_synced
from coupole.storage.journal_events import (
    JOURNAL_VERSION,
    BurstsChosen,
    FrameProven,
    FramesDiscarded,
    ProcessingAsked,
    ViewChosen,
)
from coupole.storage.line_file import utc_now
from coupole.storage.run_inputs import FOLDER as INPUTS_FOLDER
from coupole.storage.run_inputs import Inputs, changes_since, keep
from coupole.storage.run_json import RUN_JSON, SCHEMA_VERSION, read_description
from coupole.storage.run_readme import readme
from coupole.storage.stopped_process import holder_of, is_locked

_LOCK_TRIALS, _LOCK_NAP_S = 20, 0.01


@dataclass(frozen=True)
class Occupied:
    """Disk space that the views of a run already occupy."""

    bytes_of_view: Mapping[str, int] = field(default_factory=dict)
    """Bytes by name of view."""
    settled_views: frozenset[str] = frozenset()
    """Views whose files give back no more space, because their frames are discarded or they are archived."""

    @property
    def bytes(self) -> int:
        """Bytes of all views."""
        return sum(self.bytes_of_view.values())


class Run:
    """An open run folder."""

    def __init__(self, folder: Path) -> None:
        """Open an existing run. Raises InputError if there is no run, or if its run.json is wrong."""
        self.folder = folder.resolve()
        self.is_lost = False
        """True if the run's folder or journal was removed or replaced. Then nothing more is written at the run's
        path.
        """
        self._described_by = [name for name in (RUN_JSON, INPUTS_FOLDER) if (self.folder / name).exists()]
        self.about = read_description(folder)

    @staticmethod
    def create(parent: Path, name: str, inputs: Inputs, about: dict[str, Any]) -> Run:
        """Make `<UTC time>-<name>` under `parent`, with copies of the inputs. It is on the disk when this
        returns."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        folder: Path | None = None
        try:
            make_folder(parent)
            folder = _new_folder(parent, f"{stamp}-{name}")
            (folder / "views").mkdir()
            record = {
                "schema_version": SCHEMA_VERSION,
                "software": {"name": "coupole", "version": coupole.__version__},
                "created": utc_now(),
                "host": platform.node(),
                "operator": user_name(),
                **about,
                **keep(inputs, folder),
            }
            write_synced(folder / "README.txt", readme(folder.name, record))
            write_synced(folder / RUN_JSON, json.dumps(record, indent=2, ensure_ascii=False))
            sync_folder(parent)
            manifest.begin(folder)
        except OSError as error:
            if folder is not None:  # it holds nothing but copies, and is no run
                shutil.rmtree(folder, ignore_errors=True)
            raise StorageError(f"{parent}: cannot make a run folder: {error.strerror}") from error
        return Run(folder)

    @property
    def created_at(self) -> datetime:
        return datetime.fromisoformat(self.about["created"])

    @property
    def journal_path(self) -> Path:
        return self.folder / "journal.jsonl"

    def view_path(self, view: str) -> Path:
        return self.folder / "views" / f"{view}.h5"

    def occupied_space(self) -> Occupied:
        """Return the disk space that its views already occupy."""
        events = journal.read_events(self.journal_path) if self.discards else ()
        gone_views = {event.view for event in events if isinstance(event, FramesDiscarded)}
        archived_views = {path.stem for path in (self.folder / "views").glob("*.h5") if _is_archived(path)}
        return Occupied(self._allocated_bytes(), frozenset(gone_views | archived_views))

    def _allocated_bytes(self) -> dict[str, int]:
        """Return the disk space that the files of views already occupy, by name of view. Files are allocated
        completely before their first frame. Later they may be archived, or their frames may be discarded."""
        return {path.stem: _settled_bytes(path) for path in (self.folder / "views").glob("*.h5")}

    @property
    def most_views(self) -> int | None:
        """Greatest number of the run's views, if views are chosen during the run; None if the plan gives them."""
        most_views: int | None = self.about.get("most_views")
        return most_views

    def chosen_views(self) -> list[ChosenView]:
        """The choices of views that were made, from the journal; empty if the plan itself gives the views."""
        if self.most_views is None:
            return []
        return [
            ChosenView(view=event.view, reason=event.reason, figures=event.figures)
            for event in journal.read_events(self.journal_path)
            if isinstance(event, ViewChosen)
        ]

    @property
    def views(self) -> list[str]:
        """Names of the run's views, in the plan's order. If views are chosen during the run, these are the views
        chosen so far, in the order of the choices."""
        if self.most_views is None:
            return list(self.about["views"])
        return [choice.view for choice in self.chosen_views() if choice.view]

    @property
    def wants_views(self) -> bool:
        """True if more views may be chosen."""
        return self.most_views is not None and not has_enough_views(self.chosen_views())

    @property
    def expected_views(self) -> int:
        """Number of the run's views; while more views may be chosen, the greatest possible number."""
        return self.most_views if self.most_views is not None and self.wants_views else len(self.views)

    @property
    def is_open(self) -> bool:
        """True if its bursts are chosen while it runs."""
        return bool(self.about.get("chosen_in_the_run", False))

    def choices(self) -> dict[str, list[Choice]]:
        """The choices that were made for each view, from the journal; empty if the plan itself gives all
        bursts."""
        choices: dict[str, list[Choice]] = {}
        for event in journal.read_events(self.journal_path) if self.is_open else ():
            if isinstance(event, BurstsChosen):
                choice = Choice(bursts=event.bursts, reason=event.reason, figures=event.figures)
                choices.setdefault(event.view, []).append(choice)
        return choices

    def open_views(self) -> list[str]:
        """Views for which more bursts may be chosen, in the plan's order."""
        if not self.is_open:
            return []
        choices = self.choices()
        return [view for view in self.views if not has_enough(choices.get(view, ()))]

    def expected_shots(self) -> Iterable[ShotId]:
        """All shots and dark frames of the plan, without those whose LEDs are occluded in their view. If bursts
        or views are chosen while the run goes on, these are all shots that were chosen so far."""
        if self.is_open:
            choices = self.choices()
            for view in self.views:
                bursts = (burst for choice in choices.get(view, ()) for burst in choice.bursts)
                yield from (ShotId(view, label) for burst in bursts for label in burst.labels())
            return
        labels: list[str] | dict[str, list[str]] = self.about["labels"]
        for view in self.views:
            hidden_lights = set(map(Led, self.hidden_leds.get(view, ())))
            for text in labels[view] if isinstance(labels, dict) else labels:
                if (label := ShotLabel.parse(text)).light not in hidden_lights:
                    yield ShotId(view, label)

    @property
    def hidden_leds(self) -> dict[str, list[int]]:
        """LEDs that were left out of views, by name of view, because arm, camera or object occlude them."""
        leds_by_view: dict[str, list[int]] = self.about.get("hidden_leds", {})
        return leds_by_view

    @property
    def discards(self) -> bool:
        """True if its plan discards frames when their samples are safe (`discard: after_fit`)."""
        return self.about.get("discard") == "after_fit"

    @property
    def is_simulated(self) -> bool:
        """True if its frames come from a simulated cell."""
        return bool(self.about["simulated"])

    @property
    def proof(self) -> str:
        """Kind of proof of the run's frames, in the words of run.json."""
        proof: str = self.about.get("proof", "not recorded")
        return proof

    def proven(self) -> dict[ShotId, FrameProven]:
        """Return the proven shots, from the journal."""
        return {
            event.shot: event for event in journal.read_events(self.journal_path) if isinstance(event, FrameProven)
        }

    def complete_views(self) -> list[str]:
        """Views whose frames are all proven and on the disk, and for which no more are chosen, in the plan's
        order. Nothing writes into their files any more."""
        proven = self.proven()
        incomplete_views = {shot.view for shot in self.expected_shots() if shot not in proven}
        incomplete_views |= set(self.open_views())
        begun_views = {shot.view for shot in proven}
        return [v for v in self.views if v not in incomplete_views and v in begun_views]

    @property
    def asked_result(self) -> Path | None:
        """The folder of the result that is made beside the acquisition, from the newest session; None if there is
        none."""
        events = [e for e in journal.read_events(self.journal_path) if isinstance(e, ProcessingAsked)]
        return Path(events[-1].result) if events else None

    def lock(self) -> int:
        """Lock the run for this process. Raises InputError if another process acquires into it."""
        fd = os.open(self.folder / RUN_JSON, os.O_RDONLY)
        for last in (*[False] * _LOCK_TRIALS, True):
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError as error:
                if last:
                    os.close(fd)
                    raise InputError(f"{self.folder}: another process is acquiring into this run") from error
                time.sleep(_LOCK_NAP_S)  # `in_use` holds it for a moment
        return fd

    @contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Hold the lock while the context lasts."""
        fd = self.lock()
        try:
            yield
        finally:
            os.close(fd)

    @property
    def in_use(self) -> bool:
        """True while a process acquires into the run, or archives it."""
        return is_locked(self.folder / RUN_JSON)

    @property
    def holder(self) -> int | None:
        """The process that acquires into the run, or archives it; None if there is none, or if it cannot be
        found."""
        return holder_of(self.folder / RUN_JSON)

    @property
    def report_path(self) -> Path:
        """The page that the end of a session writes; it may be missing."""
        return self.folder / "report.html"

    @property
    def plan_path(self) -> Path:
        """The plan to continue with: the run's own copy, or in runs without copies the original file."""
        return self._input("plan")

    @property
    def rig_path(self) -> Path:
        """The rig to continue with: the run's own copy, or in runs without copies the original file."""
        return self._input("rig")

    def _input(self, kind: str) -> Path:
        record = self.about[kind]
        return self.folder / record["stored"] if "stored" in record else Path(record["path"])

    @property
    def go_on_command(self) -> str:
        """The complete command line that resumes the run."""
        plan = "" if "stored" in self.about["plan"] else f"{shlex.quote(self.about['plan']['path'])} "
        return f"coupole acquire {plan}--resume {shlex.quote(str(self.folder))}"

    def refuse_old_journal(self) -> None:
        """Raise InputError if the journal has an old version, which can be read but not continued."""
        if (version := journal.version(self.journal_path)) != JOURNAL_VERSION:
            raise InputError(
                f"{self.folder}: begun by coupole {self.about['software']['version']}, whose journal (version "
                f"{version}) cannot be continued: it cannot be resumed. It can be verified, exported, archived "
                "and used for calibrations; acquire its missing frames in a new run."
            )

    def refuse_removed(self) -> None:
        """Raise StorageError if the description or the inputs were removed since the run was opened."""
        for name in () if self.is_lost else self._described_by:
            if not os.path.lexists(self.folder / name):
                raise StorageError(
                    f"{self.folder / name}: was removed while frames were taken. Without it the frames cannot be "
                    "understood. Put it back, then resume the run; if it is lost, begin a new run."
                )

    def refuse_changes(self, inputs: Inputs) -> None:
        """Raise InputError if plan, rig or the files that they name differ in meaning from those at the run's
        begin."""
        if changes := changes_since(self.about, self.folder, inputs):
            own_files = {
                RUN_JSON,
                *(name for name in manifest.read_checksums(self.folder) if name.startswith("inputs/")),
            }
            if altered_files := manifest.problems(self.folder, only=own_files):
                raise InputError(
                    f"{self.folder}: cannot be resumed, because the run's own files were changed after it began: "
                    f"{'; '.join(altered_files.values())}. Only these files contain the run's plan and rig: put "
                    "the old files back (from a copy of the run), or start a new run."
                )
            raise InputError(
                f"{self.folder}: cannot be resumed, because this changed since the run began: "
                f"{'; '.join(changes)}. Put the old value or file back, continue with the run's own copies by "
                f"`{self.go_on_command}`, or start a new run."
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


def _is_archived(view_file: Path) -> bool:
    from coupole.storage import frame_file

    return frame_file.read_layout(view_file).is_archived


def _settled_bytes(view_file: Path) -> int:
    from coupole.storage import frame_file

    layout = frame_file.read_layout(view_file)
    return layout.frames * layout.frame_bytes if layout.is_archived else view_file.stat().st_blocks * 512


def name_without_time(folder_name: str) -> str:
    """Return the name that the user gave to a run: its folder's name without the time. Other names stay
    unchanged."""
    return folder_name.partition("Z-")[2] or folder_name


def user_name() -> str:
    """Return the name of the user who is logged in."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"

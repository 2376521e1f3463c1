"""Reads every proven frame of a run back, and every file that its manifest lists."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coupole.errors import InputError, StorageError
from coupole.plan.shot_id import ShotId
from coupole.storage import frame_file, journal, manifest
from coupole.storage.as_planned import AsPlanned, as_planned
from coupole.storage.discarding import discarded_views, place_of_result
from coupole.storage.journal_events import BurstsChosen, FrameProven, ViewChosen
from coupole.storage.run import Run
from coupole.storage.sample_proofs import problem_of

_HAVE_A_SHOT = (frame_file.PROVEN, frame_file.DISCARDED)


@dataclass
class Verification:
    """Result of `verify`."""

    frames: int = 0
    bad: list[str] = field(default_factory=list)
    """One line for each error."""
    missing: list[str] = field(default_factory=list)
    listed_count: int = 0
    """Number of files in the manifest; each was read and compared."""
    discarded_counts: dict[str, int] = field(default_factory=dict)
    """Number of discarded frames by view, as the plan said. The samples that replace them were read and
    compared."""
    results: list[str] = field(default_factory=list)
    """Folders of the results that have these samples."""
    unlisted: list[str] = field(default_factory=list)
    """Files that the manifest does not cover yet."""
    not_compared: str = ""
    """Reason why frames were not compared with the run's plan; empty if they were."""

    @property
    def ok(self) -> bool:
        return not self.bad and not self.missing


def verify(run: Run, progress: Callable[[int, int], None] = lambda done, total: None) -> Verification:
    """Read every proven frame back: each shot of the plan exactly once, each record and checksum right. Compare
    its light, exposure and pose with the plan that the run keeps, and every file that the manifest lists. For
    discarded frames, their samples are read instead."""
    result = Verification()
    proven = run.proven()
    result.missing = [str(shot) for shot in run.expected_shots() if shot not in proven]
    result.missing += [f"{view}: its other frames are not chosen yet" for view in run.open_views()]
    result.missing += ["its other views are not chosen yet"] * run.wants_views
    result.bad += _unchosen(run)
    by_file: dict[str, list[FrameProven]] = {}
    for frame in proven.values():
        by_file.setdefault(frame.file, []).append(frame)
    lines = Counter(
        event.shot for event in journal.read_events(run.journal_path) if isinstance(event, FrameProven)
    )
    result.bad += [f"{shot}: proven {n} times in the journal" for shot, n in lines.items() if n > 1]
    plan = _read_as_planned(run, result)
    discarded_shots = _check_discarded(run, result, proven)
    count = 0
    for name, frames in sorted(by_file.items()):
        path = run.folder / name
        try:
            layout, table = frame_file.read_layout(path), frame_file.read_frames(path)
            poses, _ = frame_file.read_poses_and_attributes(path)
        except StorageError as error:
            result.bad.append(str(error))
            continue
        claims = Counter(record["shot"] for record in table if record["state"] in _HAVE_A_SHOT)
        shots = {str(frame.shot).encode() for frame in frames}  # what the journal does not know, a crash left
        twice = [shot for shot in sorted(shots) if claims[shot] > 1]
        result.bad += [f"{name}: {shot.decode()} is in {claims[shot]} slots" for shot in twice]
        for frame in sorted(frames, key=lambda f: f.index):
            is_discarded = frame.shot in discarded_shots
            if problem := _frame_problem(
                path, layout, table, frame, is_discarded=is_discarded
            ) or _other_than_planned(plan, table[frame.index], poses, frame):
                result.bad.append(problem)
            result.frames += not is_discarded
            count += 1
            progress(count, len(proven))
    reported_files = {name for name in by_file if any(Path(name).name in problem for problem in result.bad)}
    result.bad += [
        problem for name, problem in manifest.problems(run.folder).items() if name not in reported_files
    ]
    result.listed_count = len(manifest.read_checksums(run.folder))
    result.unlisted = manifest.unlisted_files(run.folder)
    return result


def _check_discarded(run: Run, result: Verification, proven: Mapping[ShotId, FrameProven]) -> set[ShotId]:
    """Return the frames that were discarded. Faults of the samples that replace them are noted."""
    frames: set[ShotId] = set()
    for view, event in discarded_views(run).items():
        if event.view != view or any(
            shot not in proven or proven[shot].xxh3 != xxh3 for shot, xxh3 in event.frames
        ):
            result.bad.append(f"{view}: the journal names discarded frames that it has not proven")
        frames |= {shot for shot, _ in event.frames}
        result.discarded_counts[view] = len(event.frames)
        folder = place_of_result(run, event)
        result.results += [str(folder)] if str(folder) not in result.results else []
        if problem := problem_of(folder, view, event.digest):
            result.bad.append(
                f"{view}: {len(event.frames)} frames were discarded, and the samples that replace them are not "
                f"right: {problem}"
            )
    return frames


def _unchosen(run: Run) -> list[str]:
    """If frames or views are chosen in the run: find frames that the journal has before their choice, or before
    the choice of their view."""
    chosen_shots: set[ShotId] = set()
    chosen_views: set[str] = set()
    problems = []
    chooses_views = run.most_views is not None
    for event in journal.read_events(run.journal_path) if run.is_open or chooses_views else ():
        if isinstance(event, BurstsChosen):
            chosen_shots |= {ShotId(event.view, label) for burst in event.bursts for label in burst.labels()}
        elif isinstance(event, ViewChosen):
            chosen_views.add(event.view)
        elif isinstance(event, FrameProven):
            if run.is_open and event.shot not in chosen_shots:
                problems.append(f"{event.shot}: was not chosen before it was proven")
            elif chooses_views and event.shot.view not in chosen_views:
                problems.append(f"{event.shot}: its view was not chosen before it was proven")
    return problems


def _read_as_planned(run: Run, result: Verification) -> AsPlanned | None:
    try:
        plan = as_planned(run)
    except InputError as error:
        result.not_compared = str(error)
        return None
    result.bad += [*plan.problems_of_the_list(run), *plan.problems_of_choices(run)]
    return plan


def _other_than_planned(run_plan: AsPlanned | None, record: Any, poses: Any, frame: FrameProven) -> str:
    if run_plan is None:
        return ""
    if record["pose"] >= len(poses):
        return f"{frame.shot}: its record names a pose that the file does not have"
    return run_plan.problem(frame.shot, record, poses[record["pose"]])


def _frame_problem(
    path: Path, layout: frame_file.Layout, table: Any, frame: FrameProven, *, is_discarded: bool
) -> str:
    if not 0 <= frame.index < layout.frames:
        return f"{frame.shot}: slot {frame.index} is not in {path.name}"
    record = table[frame.index]
    states = _HAVE_A_SHOT if is_discarded else (frame_file.PROVEN,)
    if record["state"] not in states or record["shot"] != str(frame.shot).encode():
        recorded_shot = record["shot"].decode(errors="replace")
        return f"{frame.shot}: slot {frame.index} of {path.name} is recorded as `{recorded_shot}`"
    if is_discarded:
        recorded_xxh3 = f"{int(record['xxh3']):016x}"
        return "" if recorded_xxh3 == frame.xxh3 else f"{frame.shot}: its record has the checksum {recorded_xxh3}"
    try:
        checksum = frame_file.checksum(frame_file.read_frame(path, layout, frame.index))
    except StorageError as error:
        return f"{frame.shot}: {error}"
    if not f"{checksum:016x}" == f"{int(record['xxh3']):016x}" == frame.xxh3:
        return f"{frame.shot}: slot {frame.index} of {path.name} has checksum {checksum:016x}, not {frame.xxh3}"
    return ""

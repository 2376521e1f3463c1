"""The writes, syncs and renames of a run, cut at every point: nothing proven and synced is lost, and nothing is
called proven without its bytes, whether the process is killed there or the power fails."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import recorded_session
import write_cuts
from cells import CellFolder
from places import REPO
from recorded_session import JOINTS_DEG, LABELS, VIEWS
from write_cuts import CHANGING, RENAME, SYNC, UNKNOWN, WRITE, Call, Disk

from coupole.errors import InputError
from coupole.plan.shot_id import ShotId
from coupole.storage.run import Run
from coupole.storage.run_status import status
from coupole.storage.verification import verify
from coupole.viewing import report

COMPILER = shutil.which("cc") or shutil.which("gcc")
SOURCE = Path(__file__).with_name("recorded_writes.c")
pytestmark = pytest.mark.skipif(not COMPILER, reason="no C compiler is here to build the recorder with")


@dataclass(frozen=True)
class Recorded:
    """A session and its log; `lines` are the journal's, with the call after which each is on the disk."""

    folder: Path
    calls: list[Call]
    lines: dict[bytes, int]

    @property
    def root(self) -> Path:
        return self.folder / "runs"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("recorded")
    cell = CellFolder(folder, write_now=False)
    cell.rig_data["dome"]["leds"] = "dome.csv"
    del cell.plan_data["object"]
    cell.write(
        views=[{"kind": "joints", "name": view, "joints_deg": JOINTS_DEG} for view in VIEWS],
        lights={"kind": "ids", "ids": list(range(len(LABELS)))},
    )
    shutil.copy(REPO / "configs/domes/text-dome.csv", folder / "dome.csv")
    (folder / "runs").mkdir()
    library, log = folder / "recorder.so", folder / "calls.log"
    subprocess.run([str(COMPILER), "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
    environment = {
        **os.environ,
        "LD_PRELOAD": str(library),
        "RECORD_ROOT": f"{folder}/runs",
        "RECORD_LOG": str(log),
        "PYTHONPATH": str(REPO),
    }
    script = [sys.executable, recorded_session.__file__, str(folder)]
    subprocess.run(script, check=True, env=environment, cwd=REPO)
    calls = write_cuts.read(log)
    return Recorded(folder, calls, write_cuts.synced_lines(calls, "journal.jsonl"))


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_record_misses_no_write(recorded: Recorded, tmp_path: Path) -> None:
    """All calls, replayed, give the very files that the session left: HDF5's and the frame writer's too."""
    assert [call.path for call in recorded.calls if call.op == UNKNOWN] == []
    disk = Disk(recorded.root)
    for call in recorded.calls:
        disk.after(call)
    disk.as_the_process_sees_it(tmp_path / "runs")
    assert files_of(tmp_path / "runs") == files_of(recorded.root)


def test_all_is_on_the_disk_when_the_session_has_ended(recorded: Recorded, tmp_path: Path) -> None:
    """Names in folders, too: the power may fail after the last call."""
    disk = Disk(recorded.root)
    for call in recorded.calls:
        disk.after(call)
    disk.after_power_failed(tmp_path / "runs", random.Random(0))
    assert files_of(tmp_path / "runs") == files_of(recorded.root)


def test_a_frames_bytes_and_record_are_synced_before_its_line_is_written_and_synced(recorded: Recorded) -> None:
    """For each line `frame`: the view's last sync is after its last write, the journal's write after that sync."""
    frames = 0
    for number, call in enumerate(recorded.calls):
        if call.op != WRITE or not call.path.endswith("journal.jsonl") or b'"event":"frame"' not in call.data:
            continue
        frames += call.data.count(b'"event":"frame"')
        view = "/views/top.h5" if b'"shot":"top/' in call.data else "/views/side.h5"
        before = [
            past.op for past in recorded.calls[:number] if past.path.endswith(view) and past.op in (WRITE, SYNC)
        ]
        assert before[-1] == SYNC
        assert before.count(WRITE) >= 2  # pixels and record
        following = next(c for c in recorded.calls[number + 1 :] if c.op != WRITE or c.path != call.path)
        assert (following.op, following.path) == (SYNC, call.path)
    assert frames == len(recorded_session.VIEWS) * len(recorded_session.LABELS)


# -- cuts -----------------------------------------------------------------------------------------------------


def cope(recorded: Recorded, folder: Path, number: int, *, thorough: bool) -> None:
    """Whoever finds this folder can read it, and loses nothing that was on the disk after `number` calls."""
    on_disk = [json.loads(line) for line, synced in recorded.lines.items() if synced <= number]
    certain = {event["shot"] for event in on_disk if event["event"] == "frame"}
    try:
        run = Run(next(folder.glob("2*/run.json")).parent)
    except (StopIteration, InputError):
        assert not certain
        return
    proven = set(run.proven())
    assert certain <= set(map(str, proven))
    assert verify(run).bad == []
    found = status(run)
    assert found.proven == len(proven)
    assert found.state in ("created", "interrupted", "done")
    assert bool(found.go_on) == (len(proven) < 10)
    if thorough:
        report.write(run)
    go_on(recorded, run, proven)


def go_on(recorded: Recorded, run: Run, proven: set[ShotId]) -> None:
    """What `--resume` does: it knows what is left, and takes it."""
    run.refuse_old_journal()
    run.refuse_changes(recorded_session.inputs_in(recorded.folder))
    recorded_session.open_for_session(run)
    recorder = recorded_session.RunRecorder(run, recorded_session.METADATA)
    assert recorder.proven() == proven
    left = [shot for shot in run.expected_shots() if shot not in proven]
    for view in sorted({shot.view for shot in left}):
        recorded_session.begin_view(recorder, view)
        for shot in left:
            if shot.view == view:
                recorded_session.take(recorder, str(shot))
        recorder.end_view()
    recorder.close()
    verified = verify(Run(run.folder))
    assert (verified.bad, verified.missing, verified.frames) == ([], [], 10)


def cut(recorded: Recorded, number: int, how: str, folder: Path, chance: random.Random) -> None:
    """The folder after `number` calls, and what came of it."""
    disk = Disk(recorded.root)
    for call in recorded.calls[:number]:
        disk.after(call)
    if how == "torn":
        call = recorded.calls[number]
        disk.after(replace(call, data=call.data[: chance.randrange(1, max(2, len(call.data)))]))
    if how == "power":
        disk.after_power_failed(folder, chance)
    else:
        disk.as_the_process_sees_it(folder)
    cope(recorded, folder, number, thorough=chance.random() < 0.1)


def test_wherever_it_is_cut_nothing_proven_is_lost_and_all_can_be_read(
    recorded: Recorded, tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    """Killed before a call and within a write; the power gone, with what was not synced there, lost or torn.

    Always when a file has just got its name; elsewhere a sample that changes with the day.
    """
    points = [number for number, call in enumerate(recorded.calls) if call.op in CHANGING]
    cuts = [(number, "killed") for number in points]
    cuts += [(number, "torn") for number in points if recorded.calls[number].op == WRITE]
    cuts += [(number, "power") for number in points for _ in range(scale(1, 4))]
    seed = datetime.now(UTC).toordinal()
    chance = random.Random(seed)
    renamed = [number for number, call in enumerate(recorded.calls) if call.op == RENAME]
    after_renames = [min(number for number in points if number > rename) for rename in renamed[:-1]]
    chosen = [(number, how) for number in after_renames for how in ("killed", "power")]
    chosen += chance.sample(cuts, scale(30, len(cuts)))
    for count, (number, how) in enumerate(chosen):
        folder = tmp_path / str(count)
        try:
            cut(recorded, number, how, folder, random.Random(f"{seed} {number} {how} {count}"))
        except Exception as error:
            error.add_note(
                f"cut {count} before call {number} of {len(recorded.calls)}, {how}; seed {seed}; {folder}"
            )
            raise
        shutil.rmtree(folder)

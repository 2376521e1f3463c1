"""A run's folder: what verify finds, whose inputs may not change, who may write."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from view_files import frame, write_view

from coupole.errors import InputError
from coupole.intake.input_files import InputFiles
from coupole.plan.shot_id import ShotId
from coupole.storage import frame_file
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven, SessionStarted
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.run_status import status
from coupole.storage.verification import verify
from coupole.storage.view_writer import ViewWriter


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    for name in ("plan.yaml", "rig.yaml", "dome.csv"):
        (tmp_path / name).write_text(f"# {name}\n")
    return Inputs(tmp_path / "plan.yaml", tmp_path / "rig.yaml", (tmp_path / "dome.csv",))


@pytest.fixture
def finished(tmp_path: Path, inputs: Inputs) -> Run:
    """A run of one view and three shots, all proven."""
    labels = [f"led{k:04d}/e0" for k in range(3)]
    made = Run.create(tmp_path / "runs", "test", inputs, {"simulated": True, "views": ["top"], "labels": labels})
    checksums = write_view(made.view_path("top"))
    diary = Journal(made.journal_path)
    diary.write(SessionStarted())
    for slot, (shot, checksum) in enumerate(checksums.items()):
        prove_in(diary, shot, slot, f"{checksum:016x}")
    diary.commit()
    diary.close()
    return made


def prove_in(diary: Journal, shot: str, slot: int, checksum: str) -> None:
    diary.write(FrameProven(shot=shot, file="views/top.h5", index=slot, frame_id=100 + slot, xxh3=checksum))


def test_a_whole_run_verifies(finished: Run) -> None:
    found = verify(finished)
    assert found.ok
    assert found.frames == 3


def test_verify_finds_a_flipped_byte(finished: Run) -> None:
    path = finished.view_path("top")
    layout = frame_file.read_layout(path)
    with path.open("r+b") as file:
        file.seek(layout.data_offset + layout.frame_bytes + 777)
        byte = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte[0] ^ 1]))
    found = verify(finished)
    assert not found.ok
    assert len(found.bad) == 1
    assert found.bad[0].startswith("top/led0001/e0: slot 1 of top.h5 has checksum ")


def test_verify_finds_a_missing_shot(finished: Run) -> None:
    lines = finished.journal_path.read_text().splitlines(keepends=True)
    finished.journal_path.write_text("".join(line for line in lines if "led0002" not in line))
    found = verify(finished)
    assert found.missing == ["top/led0002/e0"]
    assert not found.ok


def test_verify_finds_a_shot_that_stands_in_two_slots(finished: Run) -> None:
    writer = ViewWriter(finished.view_path("top"), {f"top/led{k:04d}/e0": k for k in range(3)})
    slot = writer.store(frame(9), frame_id=200, camera_ns=9, exposure_us=8000)
    writer.prove(slot, "top/led0001/e0")
    writer.close()
    assert verify(finished).bad == ["views/top.h5: top/led0001/e0 is in 2 slots"]


def test_what_a_crash_left_in_the_frame_table_alone_is_missing_and_not_bad(finished: Run) -> None:
    """Twice synced as proven, and twice the journal's line was lost: only the journal counts."""
    lines = finished.journal_path.read_text().splitlines(keepends=True)
    finished.journal_path.write_text("".join(line for line in lines if "led0001" not in line))
    writer = ViewWriter(finished.view_path("top"), {f"top/led{k:04d}/e0": k for k in range(3)})
    writer.prove(writer.store(frame(9), frame_id=200, camera_ns=9, exposure_us=8000), "top/led0001/e0")
    writer.close()
    found = verify(finished)
    assert (found.bad, found.missing) == ([], ["top/led0001/e0"])


def test_verify_finds_a_shot_that_was_proven_twice(finished: Run) -> None:
    diary = Journal(finished.journal_path)
    proven = finished.proven()[ShotId.parse("top/led0001/e0")]
    prove_in(diary, proven.shot, proven.index, proven.xxh3)
    diary.commit()
    diary.close()
    assert verify(finished).bad == ["top/led0001/e0: proven 2 times in the journal"]


def test_verify_finds_a_record_that_names_another_shot(finished: Run) -> None:
    path = finished.view_path("top")
    layout = frame_file.read_layout(path)
    with path.open("r+b") as file:
        file.seek(layout.table_offset + frame_file.FRAME_DTYPE.fields["shot"][1])  # type: ignore[index]
        file.write(b"top/led0007/e0")
    assert verify(finished).bad == ["top/led0000/e0: slot 0 of top.h5 is recorded as `top/led0007/e0`"]


def test_verify_finds_a_view_that_is_gone(finished: Run) -> None:
    finished.view_path("top").unlink()
    found = verify(finished)
    assert len(found.bad) == 1
    assert "top.h5" in found.bad[0]


def test_status_counts_proven_and_missing_shots(finished: Run) -> None:
    lines = finished.journal_path.read_text().splitlines(keepends=True)
    finished.journal_path.write_text("".join(lines[:-1]))
    found = status(finished)
    assert (found.shots, found.proven, found.missing) == (3, 2, 1)


def test_unchanged_files_are_not_refused(finished: Run, inputs: Inputs) -> None:
    finished.refuse_changes(inputs)


@pytest.mark.parametrize("name", ["plan.yaml", "rig.yaml", "dome.csv"])
def test_a_changed_file_is_refused_by_name(finished: Run, inputs: Inputs, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("something else\n")
    with pytest.raises(InputError) as refused:
        finished.refuse_changes(replace(inputs, files=InputFiles()))
    assert name in str(refused.value)
    assert [n for n in ("plan.yaml", "rig.yaml", "dome.csv") if n in str(refused.value)] == [name]


def test_what_a_job_was_made_of_is_compared_not_what_is_on_the_disk_now(
    finished: Run, inputs: Inputs, tmp_path: Path
) -> None:
    for name in ("plan.yaml", "rig.yaml", "dome.csv"):
        (tmp_path / name).write_text("something else\n")
    finished.refuse_changes(inputs)


def test_a_kept_table_that_was_edited_is_no_pattern_for_todays(
    finished: Run, inputs: Inputs, tmp_path: Path
) -> None:
    stored = next(entry["stored"] for entry in finished.about["files"] if entry["path"].endswith("dome.csv"))
    for path in (finished.folder / stored, tmp_path / "dome.csv"):
        path.write_text("something else\n")
    with pytest.raises(InputError, match=r"inputs/others/dome\.csv: is not what manifest"):
        finished.refuse_changes(replace(inputs, files=InputFiles()))


def test_a_run_that_is_locked_is_refused_to_another(finished: Run) -> None:
    held = finished.lock()
    with pytest.raises(InputError, match="another process is acquiring into this run"):
        Run(finished.folder).lock()
    os.close(held)


def test_a_lock_that_was_given_back_can_be_taken(finished: Run) -> None:
    os.close(finished.lock())
    os.close(Run(finished.folder).lock())


def test_a_folder_without_run_json_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        Run(tmp_path)

"""Files that change between preflight and a run's creation, or during it: what was read is run, kept and told."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cells
import pytest
from cells import TOP, CellFolder
from in_part import in_part
from places import REPO
from real_cells import real_cell

from coupole.acquisition import session
from coupole.plan.yamlfile import read_document
from coupole.storage import journal
from coupole.storage.as_planned import as_planned
from coupole.storage.frame_file import read_frames, read_poses_and_attributes
from coupole.storage.journal_events import InputsChanged
from coupole.storage.run import Run

LIT = {"kind": "ids", "ids": [3, 700]}


def exposures_us(run: Path) -> set[int]:
    return {int(us) for path in (run / "views").glob("*.h5") for us in read_frames(path)["exposure_us"] if us}


def without_blanks(text: str) -> str:
    """As lines are broken where the terminal ends."""
    return "".join(text.split())


def told(run: Path) -> list[str]:
    return [
        one for e in journal.read_events(run / "journal.jsonl") if isinstance(e, InputsChanged) for one in e.files
    ]


def test_a_plan_edited_while_acquire_asks_to_begin_is_run_and_kept_as_it_was_checked(tmp_path: Path) -> None:
    with real_cell(tmp_path, lights=LIT, exposure={"kind": "fixed", "exposure_us": 8000}) as (cell, _):
        process = cells.start("acquire", cell.plan, stdin=subprocess.PIPE)
        assert process.stdin is not None
        assert process.stderr is not None
        said = ""
        while "[y/N] " not in said:
            letter = process.stderr.read(1)
            assert letter, said
            said += letter
        checked = cell.plan.read_text()
        cell.write(exposure={"kind": "fixed", "exposure_us": 16000})
        process.stdin.write("y\n")
        process.stdin.flush()
        ended = cells.finish(process)
        assert ended.code == 0, ended.err
        run = cell.run_folder
        about = Run(run).about
        assert exposures_us(run) == {8000}
        assert read_document(run / "inputs/plan.yaml").data["exposure"]["exposure_us"] == 8000
        assert (about["plan"]["text"], about["plan"]["sha256"]) == (
            checked,
            hashlib.sha256(checked.encode()).hexdigest(),
        )
        assert told(run) == [f"{cell.plan} was changed"]
        assert without_blanks(f"{cell.plan} was changed since it was read") in without_blanks(ended.err)
        assert cells.here("verify", run).code == 0
        resumed = cells.here("acquire", cell.plan, "--json", "--yes", "--resume", run)
        assert resumed.code == 2
        assert without_blanks("exposure_us was 8000, is 16000") in without_blanks(resumed.err)


def removed(path: Path) -> None:
    path.unlink()


def made_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def truncated(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)


@pytest.mark.parametrize("change", in_part([removed, made_a_folder, truncated], truncated))
def test_a_run_goes_on_with_what_was_read_whatever_becomes_of_its_files(
    cell: CellFolder, tmp_path: Path, change: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(REPO / "configs/domes/coupole.csv", tmp_path)
    shutil.copy(cell.plan_data["object"]["mesh"], tmp_path / "relief.ply")
    cell.rig_data["dome"]["leds"] = str(tmp_path / "coupole.csv")
    cell.plan_data["object"]["mesh"] = str(tmp_path / "relief.ply")
    cell.write(views=[TOP], lights=LIT)
    files = [cell.plan, cell.rig, tmp_path / "coupole.csv", tmp_path / "relief.ply"]
    was = {path.name: path.read_bytes() for path in files}
    asked = session.ask_to_begin

    def meanwhile(*given: object, **named: object) -> None:
        asked(*given, **named)  # type: ignore[arg-type]
        for path in files:
            change(path)

    monkeypatch.setattr(session, "ask_to_begin", meanwhile)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    run = cell.run_folder
    assert (run / "inputs/dome/coupole.csv").read_bytes() == was["coupole.csv"]
    assert (run / "inputs/object/relief.ply").read_bytes() == was["relief.ply"]
    assert Run(run).about["rig"]["text"].encode() == was["rig.yaml"]
    assert {line.split(" ")[0] for line in told(run)} == set(map(str, files))
    assert cells.here("verify", run).code == 0


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cell = CellFolder(tmp_path_factory.mktemp("cell"))
    cell.write(views=[TOP], lights=LIT, exposure={"kind": "fixed", "exposure_us": 8000})
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    return cell.run_folder


@pytest.mark.parametrize(
    ("file", "at", "value", "said"),
    [
        ("plan", "exposure.exposure_us", 16000, "exposed for 8000 us, where the run's plan has 16000 us"),
        ("plan", "views.0.distance_mm", 355, "mm and 0.00 deg from its pose in the run's plan"),
        ("plan", "lights.ids.1", 701, "the run's plan has no such shot"),
        ("rig", "flange_from_camera.abc_deg.0", 5.0, "deg from its pose in the run's plan"),
    ],
)
def test_frames_that_are_not_what_the_kept_plan_says_are_named(
    done: Path, tmp_path: Path, file: str, at: str, value: float, said: str
) -> None:
    run = Path(shutil.copytree(done, tmp_path / "run"))
    kept = run / f"inputs/{file}.yaml"
    data = part = json.loads(kept.read_text())
    *parents, last = [int(key) if key.isdigit() else key for key in at.split(".")]
    for key in parents:
        part = part[key]
    assert part[last] != value
    part[last] = value
    kept.write_text(json.dumps(data))
    lines = (run / "manifest.sha256").read_text().splitlines()
    digest = hashlib.sha256(kept.read_bytes()).hexdigest()
    lines = [f"{digest}  inputs/{file}.yaml" if line.endswith(f" inputs/{file}.yaml") else line for line in lines]
    (run / "manifest.sha256").write_text("\n".join(lines) + "\n")
    verified = cells.here("verify", run, "--json")
    assert verified.code == 6
    assert any(line.startswith("top/led") and said in line for line in verified.document["bad"]), verified.document


def test_a_frame_under_another_led_than_the_plans_is_named(done: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(done, tmp_path / "run"))
    planned = as_planned(Run(run))
    frame = next(f for f in Run(run).proven().values() if str(f.shot) == "top/led0700/e0")
    record = read_frames(run / frame.file)[frame.index].copy()
    record["led"] = 3
    poses, _ = read_poses_and_attributes(run / frame.file)
    assert planned.problem(frame.shot, record, poses[record["pose"]]) == (
        "top/led0700/e0: lit by LED 3, where the run's plan has LED 700"
    )


def test_a_kept_plan_that_is_not_understood_is_said_not_to_be_compared(done: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(done, tmp_path / "run"))
    (run / "inputs/dome/coupole.csv").unlink()
    lines = (run / "manifest.sha256").read_text().splitlines()
    (run / "manifest.sha256").write_text("\n".join(x for x in lines if not x.endswith("coupole.csv")) + "\n")
    verified = cells.here("verify", run, "--json")
    assert verified.code == 0
    assert "coupole.csv" in verified.document["not_compared"]


def test_a_resume_refuses_the_runs_own_copy_if_it_was_edited(done: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(done, tmp_path / "run"))
    kept = run / "inputs/plan.yaml"
    kept.write_text(kept.read_text().replace("8000", "16000"))
    resumed = cells.here("acquire", "--resume", run, "--json", "--yes")
    assert resumed.code == 2
    assert without_blanks("inputs/plan.yaml: is not what manifest.sha256") in without_blanks(
        resumed.document["error"]
    )

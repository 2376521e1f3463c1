"""What version 0.1 wrote is read: a run, a record, rigs. The files in `data/version-0.1` are as it left them,
but for the names of machine and operator and for paths."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cells
import pytest
import tifffile
from places import REPO

from coupole.calibration.record import read_record
from coupole.plan.cell import read_cell
from coupole.storage import journal
from coupole.storage.run import Run
from coupole.storage.run_status import status

WITNESS = REPO / "tests/data/version-0.1"
RIGS = sorted(path.name for path in (WITNESS / "rigs").glob("*.yaml"))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    shutil.copytree(WITNESS / "run", tmp_path / "run")
    return tmp_path / "run"


def test_its_run_is_verified(run: Path) -> None:
    verified = cells.here("verify", run, "--json")
    assert (verified.code, verified.document["frames"], verified.document["bad"]) == (0, 32, [])


def test_a_frame_of_its_run_that_was_changed_is_found(run: Path) -> None:
    path = run / "views" / "top.h5"
    slot = json.loads(next(line for line in (run / "journal.jsonl").read_text().splitlines() if "led0002" in line))
    from coupole.storage import frame_file

    with path.open("r+b") as file:
        file.seek(frame_file.read_layout(path).data_offset + slot["index"] * 64 * 32 * 2)
        file.write(b"\xff\x0f")
    verified = cells.here("verify", run, "--json")
    assert verified.code == 6
    assert "top/led0002/e0" in verified.document["bad"][0]


def test_the_end_of_a_pause_in_its_journal_is_no_session(run: Path) -> None:
    tags = [event.event for event in journal.read_events(run / "journal.jsonl")]
    assert tags[0] == "start"
    assert "resume" not in tags
    assert tags.count("continue") == 1
    assert status(Run(run)).state == "done"


def test_its_run_is_exported(run: Path, tmp_path: Path) -> None:
    ended = cells.here("export", run, "--to", "tiff", "--shots", "led*", "--out", tmp_path / "out")
    assert ended.code == 0, ended.err
    exported = sorted((tmp_path / "out").rglob("*.tif*"))
    assert len(exported) == 8
    assert tifffile.imread(exported[0]).shape == (32, 64)


def test_its_run_is_archived(run: Path) -> None:
    assert cells.here("archive", run).code == 0
    assert cells.here("verify", run).code == 0


def test_its_run_is_calibrated_from_with_the_same_figures(run: Path, tmp_path: Path) -> None:
    ended = cells.here("calibrate", "dark", run, "--out", tmp_path, "--name", "dark")
    assert ended.code == 0, ended.err
    before, now = read_record(WITNESS / "records/dark.yaml"), read_record(tmp_path / "dark.yaml")
    for name in ("read_noise_dn", "offset_dn", "current_dn_per_s"):
        assert now.value(name) == pytest.approx(before.value(name), rel=1e-9)


def test_its_record_is_read_with_its_uncertainty(tmp_path: Path) -> None:
    record = read_record(WITNESS / "records/dark.yaml")
    assert (record.kind, record.validity.camera) == ("dark", "memory camera sim-0")
    assert record.value("offset_dn") == pytest.approx(64.016, abs=1e-3)


def test_its_run_is_not_resumed_and_the_remedy_is_said(run: Path) -> None:
    before = (run / "journal.jsonl").read_bytes()
    ended = cells.here("acquire", WITNESS / "plan.yaml", "--resume", run, "--yes")
    assert ended.code == 2
    assert "begun by coupole 0.1.0" in ended.err
    assert "acquire its missing frames in a new run" in ended.err
    assert (run / "journal.jsonl").read_bytes() == before


@pytest.mark.parametrize("name", RIGS)
def test_its_rigs_are_read_with_one_remark_for_each_old_name(name: str) -> None:
    path = WITNESS / "rigs" / name
    cell, today = read_cell(path), read_cell(REPO / "configs/rigs" / name)
    assert cell.rig.camera.driver == today.rig.camera.driver
    assert cell.rig.robot.driver == today.rig.robot.driver
    assert today.remarks == ()
    old = [word for word in path.read_text().split() if word.strip("{},").startswith(("drivers.", "sim."))]
    renamed = [word for word in old if "ledbox" not in word and "drivers.ur:" not in word]
    assert len(cell.remarks) == len(renamed)
    assert all(f"{name}:" in remark and "is now called `" in remark for remark in cell.remarks)


def test_a_plan_of_its_cell_is_checked_and_the_remark_is_shown() -> None:
    ended = cells.here("check", WITNESS / "plan.yaml", "--no-paths")
    assert ended.code == 0, ended.err
    assert ended.err.count("`drivers.kuka_rsi:KukaRsi` is now called `drivers.kuka.rsi:KukaRsi`") == 1

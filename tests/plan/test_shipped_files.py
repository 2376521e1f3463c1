"""Names of shipped rigs and plans, where a path may stand."""

from __future__ import annotations

from pathlib import Path

import cells
import pytest
from places import REPO

from coupole.plan.cell import read_cell
from coupole.plan.reading import read_plan

RIGS = REPO / "configs/rigs"


def test_a_name_stands_for_a_shipped_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_cell(Path("sim-gige")).document.path == RIGS / "sim-gige.yaml"
    assert read_plan(Path("demo"), Path("sim-gige")).cell.rig.name == read_cell(RIGS / "sim-gige.yaml").rig.name
    assert read_cell(Path("sim")).storage_folder == REPO / "runs"


def test_a_file_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = cells.CellFolder(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sim").write_text(cell.rig.read_text())
    cell.write(rig="sim")
    assert read_plan(cell.plan).cell.document.path == tmp_path / "sim"
    assert read_cell(Path("sim")).rig.sensor.width_px == 128


def test_a_name_that_is_none_is_refused_at_its_place(tmp_path: Path) -> None:
    cell = cells.CellFolder(tmp_path)
    cell.write(rig="simm")
    ended = cells.here("check", cell.plan, "--no-paths")
    assert ended.code == 2
    assert f"expected a rig file; there is no {tmp_path}/simm" in ended.err

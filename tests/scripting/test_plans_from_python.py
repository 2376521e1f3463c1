"""`coupole.Plan` and `coupole.Rig`: read, built, checked, written."""

from __future__ import annotations

from pathlib import Path

import cells
import pytest
from places import REPO

import coupole
from coupole.plan.reading import read_plan

TOP = {**cells.TOP, "target_mm": (0, 0, 30)}


def small_plan(**keys: object) -> coupole.Plan:
    given = {"schema_version": 1, "name": "small", "rig": Path("sim"), "views": [TOP], "lights": {"kind": "all"}}
    return coupole.Plan.model_validate(given | {"exposure": {"kind": "fixed", "exposure_us": 8000}} | keys)


@pytest.mark.parametrize("name", sorted(path.stem for path in (REPO / "configs/plans").glob("*.yaml")))
def test_a_shipped_plan_that_is_written_elsewhere_reads_back_equal(name: str, tmp_path: Path) -> None:
    plan = coupole.Plan.read(name)
    path = plan.write(tmp_path / "plan.yaml")
    assert coupole.Plan.read(path) == plan
    files = read_plan(path)
    assert files.cell.rig == read_plan(REPO / f"configs/plans/{name}.yaml").cell.rig


@pytest.mark.parametrize("name", sorted(path.stem for path in (REPO / "configs/rigs").glob("*.yaml")))
def test_a_shipped_rig_that_is_written_elsewhere_reads_back_equal(name: str, tmp_path: Path) -> None:
    rig = coupole.Rig.read(name)
    assert coupole.Rig.read(rig.write(tmp_path / "rig.yaml")) == rig


def test_a_plan_built_in_python_names_its_files_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "relief.ply").write_bytes(cells.COARSE_RELIEF.read_bytes())
    plan = small_plan(object={"id": "relief", "mesh": Path("relief.ply")})
    assert plan.object is not None
    assert plan.object.mesh == tmp_path / "relief.ply"
    (tmp_path / "plans").mkdir()
    path = plan.write("plans/small.yaml")
    assert "rig: sim\n" in path.read_text()
    assert coupole.Plan.read(path) == plan
    assert read_plan(path).mesh_path == tmp_path / "relief.ply"
    with pytest.raises(coupole.errors.InputError, match="exists already"):
        plan.write(path)


def test_findings_of_preflight_are_those_of_the_command(tmp_path: Path) -> None:
    plan = small_plan(lights={"kind": "every", "every": 100}, object={"id": "relief", "dose_budget_lux_h": 1e-6})
    report = plan.check(paths=False, disk_speed=False)
    assert (report.shots, len(report.views)) == (11, 1)
    (refusal,) = report.refusals
    assert "its budget is 1e-06 lux.h" in refusal
    said = cells.here("check", plan.write(tmp_path / "p.yaml"), "--no-paths", "--no-disk-speed", "--json").document
    assert said["refusals"] == report.refusals
    assert (said["shots"], said["dose_lux_h"]) == (report.shots, report.dose_lux_h)
    assert small_plan(lights={"kind": "every", "every": 100}).check(disk_speed=False).refusals == []


def test_mistakes_of_a_file_have_their_place(tmp_path: Path) -> None:
    path = small_plan().write(tmp_path / "plan.yaml")
    path.write_text(path.read_text().replace("exposure_us: 8000", "exposure_ms: 8"))
    with pytest.raises(coupole.errors.InputError) as refused:
        coupole.Plan.read(path)
    assert {problem.key for problem in refused.value.problems} >= {"exposure.exposure_ms"}
    assert all(problem.line > 1 for problem in refused.value.problems)

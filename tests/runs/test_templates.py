"""`coupole plan new`: every template is a plan that can be run on the simulated cell."""

from __future__ import annotations

from pathlib import Path

import cells
import pytest

from coupole.calibration.lens.board import read_board
from coupole.plan.cell import read_cell
from coupole.plan.templates import TEMPLATES

RIG = cells.REPO / "configs/rigs/sim.yaml"


@pytest.mark.parametrize("template", sorted(TEMPLATES))
def test_a_new_plan_passes_preflight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, template: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert cells.here("plan", "new", "mine", "--template", template, "--rig", RIG).code == 0
    ended = cells.here("check", tmp_path / "mine.yaml", "--json")
    assert ended.document["refusals"] == []
    assert ended.document["paths_checked"]


def test_a_plan_made_anywhere_finds_the_simulated_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert cells.here("plan", "new", "mine").code == 0
    assert cells.here("check", tmp_path / "mine.yaml", "--no-paths").code == 0


@pytest.mark.parametrize("name", ["my bunny", "../mine", "", "-x/y", "n" * 65])
def test_a_name_that_no_plan_may_have_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = cells.here("plan", "new", "--", name)
    assert ended.code == 2
    assert "expected a name of letters, digits" in ended.err
    assert list(tmp_path.iterdir()) == []


def test_a_simulated_cell_has_on_its_support_what_is_to_be_photographed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cells.here("plan", "new", "mine", "--template", "charuco", "--rig", RIG).code == 0
    rig = read_cell(tmp_path / "mine-rig.yaml").rig
    assert rig.world is not None
    (thing,) = rig.world.settings["things"]
    described = read_board(tmp_path / "mine-board.yaml")
    assert thing["kind"] == "charuco_board"
    assert (thing["square_mm"], thing["marker_mm"]) == (described.square_mm, described.marker_mm)
    real = cells.REPO / "configs/rigs/la-coupole.yaml"
    assert cells.here("plan", "new", "real", "--template", "charuco", "--rig", real).code == 0
    assert not (tmp_path / "real-rig.yaml").exists()


def test_a_plan_with_the_name_of_a_template_is_made_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cells.here("plan", "new", "charuco", "--rig", RIG).code == 0
    assert (tmp_path / "charuco.yaml").read_text().count("look_at") == 40
    assert cells.here("plan", "new", "charuco", "--rig", RIG).code == 2

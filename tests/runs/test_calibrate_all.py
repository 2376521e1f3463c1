"""`coupole calibrate all`: plans, runs and records from nothing, gone on with after a stop."""

from __future__ import annotations

from pathlib import Path

import cells
import pytest
from imperfect_cells import imperfect_rig
from ruamel.yaml import YAML

from coupole.calibration.record import read_record
from coupole.commands.campaign import Campaign, Operator, Repeatability
from coupole.plan.templates import TEMPLATES
from coupole.storage.run_status import is_complete
from coupole.viewing.terminal import make_console

DARK_FRAMES = 120
"""Of the plan `darks`, with its marks."""
STEPS = ("--only", "darks", "--only", "response")


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The imperfect cell with small frames, faster than life."""
    path = tmp_path / "rig.yaml"
    with path.open("w") as file:
        YAML().dump(imperfect_rig(256, speed=5.0), file)
    return path


@pytest.mark.timeout(600)
def test_records_are_made_from_nothing_and_not_made_twice(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "calibrations"
    first = cells.here("calibrate", "all", "--rig", rig, "--out", out, *STEPS, "--json")
    assert first.code == 0, first.err
    assert set(first.document["records"]) == {"dark", "response"}
    for kind, path in first.document["records"].items():
        record = read_record(Path(path))
        assert record.kind == kind
        assert record.simulated
        assert record.is_accepted
    runs = sorted((out / "runs").glob("2*"))
    assert len(runs) == 2

    take_away(out, "response")
    again = cells.here("calibrate", "all", "--rig", rig, "--out", out, *STEPS, "--json")
    assert again.code == 0, again.err
    assert again.document["records"] == first.document["records"]
    assert sorted((out / "runs").glob("2*")) == runs  # its run was there: only the record was made again

    take_away(out, "response")
    strict = ("--limit", "linearity=1e-9", "--name", "response", "--out", out)
    assert cells.here("calibrate", "response", runs[1], *strict).code == 3
    refused = cells.here("calibrate", "all", "--rig", rig, "--out", out, *STEPS, "--json")
    assert refused.code == 3
    assert "response.yaml: not accepted" in refused.err
    assert "remove response.*" in refused.err

    take_away(out, "response")
    plan = out / "plans" / "response.yaml"
    plan.write_text(plan.read_text().replace("[500, 1000,", "[750, 1000,"))
    anew = cells.here("calibrate", "all", "--rig", rig, "--out", out, *STEPS, "--json")
    assert anew.code == 0, anew.err
    assert len(list((out / "runs").glob("2*"))) == 3  # the plan was changed: its run is another one


@pytest.mark.timeout(600)
def test_a_run_of_dark_frames_that_was_stopped_is_resumed(rig: Path, tmp_path: Path) -> None:
    """It has no shots, so none was missing: a record was then made of the dark frames that there were."""
    out = tmp_path / "calibrations"
    words = ("calibrate", "all", "--rig", rig, "--out", out, "--only", "darks", "--json")
    process = cells.start(*words)

    def moving_run() -> Path | None:
        return next((run for run in (out / "runs").glob("2*") if cells.events(run, "move")), None)

    run = cells.wait_until(moving_run, "a motion")
    process.terminate()
    assert cells.finish(process).code == 143
    assert cells.frame_lines(run) < DARK_FRAMES
    assert not is_complete(run)
    again = cells.here(*words)
    assert again.code == 0, again.err
    assert cells.frame_lines(run) == DARK_FRAMES


def take_away(folder: Path, record: str) -> None:
    """A record and all that stands beside it."""
    for path in folder.glob(f"{record}.*"):
        path.unlink()


def test_a_plan_that_was_changed_by_hand_is_kept(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "calibrations"
    plan = out / "plans" / "darks.yaml"
    plan.parent.mkdir(parents=True)
    text = TEMPLATES["darks"].format(name="darks", rig=rig).replace("darks_per_view: 20", "darks_per_view: 12")
    plan.write_text(text)
    ended = cells.here("calibrate", "all", "--rig", rig, "--out", out, "--only", "darks", "--json")
    assert ended.code == 0, ended.err
    assert plan.read_text() == text


def test_a_step_that_does_not_exist_is_refused() -> None:
    ended = cells.here("calibrate", "all", "--only", "nothing")
    assert ended.code == 2
    assert "darks" in ended.err


def test_a_real_cell_is_asked_for_the_object_s_scan(tmp_path: Path) -> None:
    rig = cells.REPO / "configs/rigs/la-coupole.yaml"
    ended = cells.here("calibrate", "all", "--rig", rig, "--out", tmp_path, "--only", "mesh")
    assert ended.code == 2
    assert "--scan FOLDER" in ended.err


def test_a_description_of_the_tile_that_was_changed_by_hand_is_kept(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "calibrations"
    out.mkdir()
    (out / "tile.yaml").write_text("schema_version: 1\nside_mm: 40.0\n")
    operator = Operator(make_console(quiet=True), is_asked=False)
    Campaign(rig, out, None, Repeatability(0.03, 0.003), operator, is_simulated=True)
    assert (out / "tile.yaml").read_text() == "schema_version: 1\nside_mm: 40.0\n"

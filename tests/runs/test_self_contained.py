"""A run's folder alone: moved away from plan, rig, dome and mesh, it is read, explained and brought to its end."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from cells import SIDE, TOP, CellFolder
from places import REPO

from coupole.commands.calibrating import rig_of
from coupole.plan.cell import read_cell
from coupole.preflight.job import read_job

LICENCE, CONTACT = "CC BY 4.0", "the museum's registrar"


@dataclass(frozen=True)
class Moved:
    """A complete run whose cell's files are gone, and what its rig's file said."""

    run: Path
    rig: str
    plan: str

    def copy(self, folder: Path) -> Path:
        return Path(shutil.copytree(self.run, folder / self.run.name))


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Moved:
    folder = tmp_path_factory.mktemp("cell")
    cell = CellFolder(folder)
    shutil.copy(REPO / "configs/domes/coupole.csv", folder)
    shutil.copy(REPO / "configs/objects/relief.ply", folder)
    cell.rig_data["dome"]["leds"] = "coupole.csv"
    cell.rig_data["licence"] = LICENCE
    cell.plan_data["object"]["mesh"] = "relief.ply"
    exposure = {"kind": "bracket", "exposures_us": [2000, 8000]}  # dark frames of two exposures, to calibrate from
    cell.write(views=[TOP, SIDE], lights={"kind": "ids", "ids": [3, 700]}, exposure=exposure, contact=CONTACT)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    away = tmp_path_factory.mktemp("stick") / "a run"
    rig, plan = cell.rig.read_text(), cell.plan.read_text()
    shutil.move(cell.run_folder, away)
    shutil.rmtree(folder)
    return Moved(away, rig, plan)


def test_coreutils_check_every_file_of_it(moved: Moved) -> None:
    tool = shutil.which("sha256sum")
    assert tool
    done = subprocess.run(
        [tool, "-c", "manifest.sha256"], cwd=moved.run, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    listed = {line.removesuffix(": OK") for line in done.stdout.splitlines()}
    assert {"views/top.h5", "views/side.h5", "inputs/object/relief.ply", "report.html"} <= listed


def test_it_is_verified_and_nothing_in_it_is_unlisted(moved: Moved) -> None:
    found = cells.here("verify", moved.run, "--json")
    assert found.code == 0
    assert (found.document["bad"], found.document["unlisted"]) == ([], [])
    assert found.document["listed"] == 11


def test_its_status_is_told(moved: Moved) -> None:
    found = cells.here("status", moved.run, "--json").document
    assert (found["state"], found["frames_left"], found["go_on"], found["faults"]) == ("done", 0, "", [])
    assert [session["outcome"] for session in found["sessions"]] == ["done"]


def test_its_frames_are_exported(moved: Moved, tmp_path: Path) -> None:
    ended = cells.here("export", moved.run, "--to", "tiff", "--shots", "led*", "--out", tmp_path / "out")
    assert ended.code == 0, ended.err
    assert len(list((tmp_path / "out").iterdir())) == 8


def test_its_copies_are_a_plan_and_a_rig_that_mean_the_same(moved: Moved) -> None:
    job = read_job(moved.run / "inputs/plan.yaml")
    assert (job.plan.name, job.schedule.shots) == ("small", 8)
    assert len(job.cell.leds.ids) == 1080
    assert len(job.shape.corners_mm) > 1000
    assert job.cell.rig.arm is not None
    shipped = read_cell(REPO / "configs/rigs/sim.yaml").rig.arm
    assert job.cell.rig.arm == shipped
    about = json.loads((moved.run / "run.json").read_text())
    assert (about["plan"]["text"], about["rig"]["text"]) == (moved.plan, moved.rig)


def test_calibrations_read_its_own_rig(moved: Moved, tmp_path: Path) -> None:
    assert rig_of(moved.run) == moved.run / "inputs/rig.yaml"
    ended = cells.here("calibrate", "dark", moved.run, "--out", tmp_path, "--name", "dark")
    assert ended.code == 0, ended.err
    assert (tmp_path / "dark.yaml").is_file()


def test_a_shot_that_is_left_is_taken_with_its_own_copies(moved: Moved, tmp_path: Path) -> None:
    run = moved.copy(tmp_path)
    journal = run / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(line for line in lines if "side/led0700/e0" not in line))
    command = cells.here("status", run, "--json").document["go_on"]
    assert command == f"coupole acquire --resume '{run}'"
    ended = cells.here("acquire", "--resume", run, "--yes", "--json")
    assert ended.code == 0, ended.err
    assert (ended.document["proven"], ended.document["missing"]) == (8, 0)
    cells.assert_each_shot_proven_once(run)


# -- what is in it --------------------------------------------------------------------------------------------


def test_the_readmes_lines_read_a_picture_without_coupole(moved: Moved) -> None:
    text = (moved.run / "README.txt").read_text()
    code = text[text.index("import h5py") : text.index("A picture is named")]
    assert len(code.strip().splitlines()) == 5
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], cwd=moved.run, capture_output=True, text=True, check=True
    )
    assert re.match(r"\('top/\w+/e\d', \d+\) \[\[", done.stdout)
    assert f"licence     {LICENCE}\n" in text
    assert f"contact     {CONTACT}\n" in text


def test_a_views_file_says_units_and_frames_of_leds_lens_and_poses(moved: Moved) -> None:
    table = np.loadtxt(REPO / "configs/domes/coupole.csv", delimiter=",", comments=("#", "id"))
    with h5py.File(moved.run / "views/top.h5") as file:
        entry = file["entry"]
        assert entry["definition"][()] == b"NXentry"
        begun = json.loads((moved.run / "journal.jsonl").read_text().splitlines()[1])["t"]
        assert entry["start_time"][()].decode() > begun
        leds, lens = entry["instrument/leds"], entry["instrument/lens"]
        assert np.allclose(leds["position_mm"], table[:, 2:5])
        assert np.allclose(leds["normal"], table[:, 5:8], atol=1e-3)
        assert leds["id"][:].tolist() == table[:, 0].tolist()
        assert dict(leds["position_mm"].attrs) == {"units": "mm", "frame": "the robot's base"}
        # a thin lens of 35 mm that is focused at 335 mm, pixels of 176 um
        assert lens["fx"][()] == pytest.approx(35 * 335 / (335 - 35) / 0.176)
        assert (lens["cx"][()], lens["cy"][()]) == (63.5, 47.5)
        assert lens["fx"].attrs["units"] == "px"
        assert lens["source"][()].startswith(b"nominal")
        poses = entry["instrument/robot/poses"]
        assert (poses.attrs["joints_deg_units"], poses.attrs["base_from_camera_units"]) == ("degree", "mm")
        assert entry["instrument/detector/frames"].attrs["exposure_us_units"] == "us"


def test_its_report_leads_with_outcome_exposure_light_and_duration(moved: Moved) -> None:
    text = (moved.run / "report.html").read_text()
    for page in (text, _renewed(moved.run)):
        headings = re.findall(r"<h2>(.*?)</h2>", page)
        assert headings == [
            "What was measured",
            "Exposure",
            "Coverage of the object",
            "Light on the object",
            "Time",
            "What went wrong",
            "Pictures",
            "Devices and software",
        ]
        assert page.index(">outcome<") < page.index("<h2>")
        assert page.index("Devices and software") < page.index("drift ppm")
        assert "<b class=ok>done</b>" in page
        assert "1 session, no pause" in page


def _renewed(run: Path) -> str:
    other = run.parent / "other.html"
    assert cells.here("report", run, "--out", other).code == 0
    return other.read_text()

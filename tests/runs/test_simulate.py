"""`coupole simulate`: frames of a plan without devices."""

from __future__ import annotations

from pathlib import Path

import cells
import numpy as np
import pytest
from cells import SIDE, TOP, CellFolder
from PIL import Image

from coupole.preflight.job import read_job
from coupole.storage import frame_file
from coupole.viewing.raw_preview import develop


@pytest.fixture
def rendered(cell: CellFolder) -> Path:
    cell.write(views=[TOP, SIDE])
    out = cell.folder / "pictures"
    ended = cells.here("simulate", cell.plan, "--frames", "6", "--out", out, "--json")
    assert ended.code == 0, ended.err
    assert [still["file"] for still in ended.document["frames"]] == [
        f"{view}-led{led:04d}-e0.png" for view in ("top", "side") for led in (0, 520, 1060)
    ]
    return out


def test_a_plan_becomes_pictures_of_its_views_and_lights(rendered: Path) -> None:
    names = {path.name for path in rendered.iterdir()}
    assert len(names) == 7
    assert "sheet.png" in names
    for path in rendered.iterdir():
        with Image.open(path) as picture:
            assert "simulated" in picture.info["Description"]
            assert np.asarray(picture).max() > 60


def test_a_simulated_picture_is_what_the_run_takes_but_for_noise_and_the_arms_error(
    cell: CellFolder, rendered: Path
) -> None:
    assert cell.acquire().code == 0
    frame = cells.stored(cell.run_folder)["top/led0520/e0"]
    facts = frame_file.read_facts(cell.run_folder / "views/top.h5")
    taken = develop(frame.pixels, **facts).astype(float)
    with Image.open(rendered / "top-led0520-e0.png") as picture:
        simulated = np.asarray(picture).astype(float)
    assert taken.shape == simulated.shape
    assert np.corrcoef(taken.ravel(), simulated.ravel())[0, 1] > 0.95
    with Image.open(rendered / "top-led1060-e0.png") as picture:
        assert np.corrcoef(taken.ravel(), np.asarray(picture).astype(float).ravel())[0, 1] < 0.9


def test_frames_may_be_made_smaller(cell: CellFolder) -> None:
    ended = cells.here("simulate", cell.plan, "--frames", "1", "--width", "64", "--out", cell.folder / "small")
    assert ended.code == 0, ended.err
    with Image.open(cell.folder / "small/top-led0000-e0.png") as picture:
        assert picture.size == (32, 24)


def test_a_plan_without_light_has_nothing_to_show(cell: CellFolder) -> None:
    cell.write(lights={"kind": "none"})
    ended = cells.here("simulate", cell.plan, "--out", cell.folder / "none")
    assert ended.code == 2
    assert "expected shots with light" in ended.err
    assert not (cell.folder / "none").exists()


def test_a_wrong_plan_is_refused_at_its_line(cell: CellFolder) -> None:
    cell.write(views=[{**TOP, "kind": "lookat"}])
    ended = cells.here("simulate", cell.plan)
    assert ended.code == 2
    assert "plan.yaml:" in ended.err


def test_a_view_by_the_joints_of_a_ur_is_rendered_from_where_its_flange_is(tmp_path: Path) -> None:
    """The same view, once as the camera's pose and once as joints of a UR10e that lead there, in two cells."""
    pictures = []
    for by_joints in (False, True):
        cell = CellFolder(tmp_path, speed=1.0)
        cell.moved_by_ur("ur10e")
        cell.write(views=[TOP])
        job = read_job(cell.plan)
        (visit,) = job.motion.itinerary(job.schedule.views, job.cell.rig.motion.home_joints_deg).visits
        assert visit is not None
        if by_joints:
            cell.write(views=[{"kind": "joints", "name": "top", "joints_deg": visit.joints_deg.tolist()}])
        out = tmp_path / str(by_joints)
        ended = cells.here("simulate", cell.plan, "--frames", "1", "--out", out, "--json")
        assert ended.code == 0, ended.err
        with Image.open(out / ended.document["frames"][0]["file"]) as picture:
            pictures.append(np.asarray(picture).astype(float))
    assert pictures[0].max() > 60
    assert np.abs(pictures[0] - pictures[1]).mean() < 1.0

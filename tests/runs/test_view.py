"""`coupole view`: a picture and a page of plans that are fine, and above all of plans that are not."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import SIDE, TOP, CellFolder
from numpy.typing import NDArray
from PIL import Image

from coupole.motion import singularities
from coupole.motion.itinerary import Itinerary, arm_of
from coupole.preflight.job import Job, read_job
from coupole.viewing.view_picture import write_picture
from coupole.viewing.view_scene import scene_of

CLOSE = {**TOP, "name": "close", "distance_mm": 60}
FAR = {**SIDE, "name": "far", "distance_mm": 1200, "elevation_deg": 20}


@dataclass(frozen=True)
class Seen:
    """What one run of the command made."""

    ended: cells.Ended
    folder: Path

    @property
    def png(self) -> Path:
        return self.folder / "small.png"

    @property
    def html(self) -> str:
        return (self.folder / "small.html").read_text(encoding="utf-8")


def seen(cell: CellFolder, *options: str, **plan: Any) -> Seen:
    """Run the command on a cell whose plan has been changed."""
    cell.write(**plan)
    return Seen(
        cells.here("view", cell.plan, "--out", cell.folder / "out", "--json", *options), cell.folder / "out"
    )


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return seen(CellFolder(tmp_path_factory.mktemp("good")), views=[TOP, SIDE])


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return seen(CellFolder(tmp_path_factory.mktemp("bad")), views=[TOP, CLOSE, FAR])


def red(png: Path) -> int:
    """How many pixels of a picture are of the one red that stands for what must not be."""
    pixels = np.asarray(Image.open(png).convert("RGB")).astype(int)
    r, g, b = np.moveaxis(pixels, -1, 0)
    return int(((r > 150) & (g < 0.35 * r) & (b < 0.35 * r)).sum())


class Addresses(HTMLParser):
    """What a page would fetch, and its text without scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.text = ""
        self._script = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._script = tag in ("script", "style")
        self.fetched += [value or "" for name, value in attrs if name in ("src", "href", "data", "action")]

    def handle_endtag(self, tag: str) -> None:
        self._script = False

    def handle_data(self, data: str) -> None:
        self.text += "" if self._script else data


def test_the_command_names_both_files_and_ends_well(good: Seen) -> None:
    assert good.ended.code == 0, good.ended.err
    assert good.ended.document == {"png": str(good.png), "html": str(good.folder / "small.html")}


def test_the_picture_is_one_and_not_too_large(good: Seen) -> None:
    picture = Image.open(good.png)
    picture.verify()
    assert picture.format == "PNG"
    assert picture.size == (1800, 1300)
    assert good.png.stat().st_size < 300_000


def test_the_page_names_all_views_and_fetches_nothing(good: Seen) -> None:
    page = Addresses(good.html)
    assert page.fetched == []
    assert "http" not in page.text
    assert re.search(r"\d top", good.html)
    assert re.search(r"\d side", good.html)
    assert len(good.html) < 8_000_000


def test_a_plan_without_fault_shows_no_red(good: Seen) -> None:
    assert red(good.png) == 0
    assert "refused" not in Addresses(good.html).text


def test_a_refused_plan_is_drawn_all_the_same(bad: Seen) -> None:
    assert bad.ended.code == 0, bad.ended.err
    assert red(bad.png) > 2000


def test_the_page_tells_why_views_are_refused(bad: Seen) -> None:
    text = Addresses(bad.html).text
    assert "view close: camera would be" in text
    assert "view far: out of reach" in text
    assert re.search(r"close: camera \d+ mm (from|inside) the", bad.html)


def test_a_ur_is_drawn_with_its_own_links(cell: CellFolder) -> None:
    cell.moved_by_ur("ur10e")
    cell.world_settings["speed"] = 1.0
    cell.write(views=[TOP])
    job = read_job(cell.plan)
    itinerary = job.motion.itinerary(job.schedule.views, job.cell.rig.motion.home_joints_deg)
    scene = scene_of(job, itinerary, job.motion.bodies, [])
    stop = scene.stops[0]
    assert stop.joints_deg is not None
    names = [solid.name for solid in scene.arm(stop.joints_deg)]
    assert names == [
        "base",
        "shoulder",
        "upper arm",
        "forearm",
        "wrist 1",
        "wrist 2",
        "wrist 3",
        "camera",
        "cables",
    ]


def test_without_json_refusals_and_files_are_told(cell: CellFolder) -> None:
    cell.write(views=[CLOSE])
    ended = cells.here("view", cell.plan, "--out", cell.folder)
    assert ended.code == 0
    assert ended.out == ""
    assert "planning paths to 1 views" in ended.err
    assert "refused: view close: camera" in ended.err
    assert str(cell.folder / "small.html") in ended.err


def test_a_way_that_is_blocked_is_shown_where_it_first_touches(cell: CellFolder) -> None:
    goal_deg = _behind_something(read_job(cell.plan))
    cell.write(views=[{"kind": "joints", "name": "behind", "joints_deg": goal_deg.tolist()}])
    job = read_job(cell.plan)
    nowhere = Itinerary((None,), ("view behind: no path to it was found",), ())
    scene = scene_of(job, nowhere, job.motion.bodies, nowhere.refusals)
    (stop,) = scene.stops
    assert stop.clash is not None
    assert job.motion.bodies.contacts(stop.clash.joints_deg)[0] == stop.clash.contact
    home_deg = np.array(job.cell.rig.motion.home_joints_deg)
    along, whole = stop.clash.joints_deg - home_deg, goal_deg - home_deg
    share = float(along @ whole / (whole @ whole))
    assert 0 < share < 1
    assert along == pytest.approx(share * whole)
    write_picture(scene, cell.folder / "blocked.png")
    assert red(cell.folder / "blocked.png") > 2000


def _behind_something(job: Job) -> NDArray[np.float64]:
    """Joint angles that are clear, with something between home and them."""
    random, arm = np.random.default_rng(2), arm_of(job.cell.rig)
    home_deg = np.array(job.cell.rig.motion.home_joints_deg)
    while True:
        joints = random.uniform(*np.array(arm.limits_deg).T)
        clear = not job.motion.bodies.contacts(joints) and singularities.margin(arm, joints) >= 1.0
        if clear and job.motion.bodies.contact_on_the_way(home_deg, joints):
            return joints


def test_views_are_numbered_in_the_order_of_visiting_and_refused_ones_come_last(cell: CellFolder) -> None:
    cell.write(views=[FAR, SIDE, TOP])
    job = read_job(cell.plan)
    itinerary = job.motion.itinerary(job.schedule.views, job.cell.rig.motion.home_joints_deg)
    stops = scene_of(job, itinerary, job.motion.bodies, itinerary.refusals).stops
    expected = [job.schedule.views[index].name for index in itinerary.order]
    assert [stop.name for stop in stops] == [*expected, "far"]
    assert [stop.number for stop in stops] == [1, 2, 3]


def test_a_plan_without_mesh_or_single_lights_is_drawn(cell: CellFolder) -> None:
    joints = {"kind": "joints", "name": "park", "joints_deg": [0, -120, 120, 0, -90, 0]}
    shown = seen(cell, "--no-paths", views=[joints], object={"id": "nothing"}, lights={"kind": "panels"})
    assert shown.ended.code == 0, shown.ended.err
    assert "1 park" in shown.html
    assert "were not checked" in shown.html


def test_a_volume_to_keep_out_of_turns_red_where_the_arm_would_touch_it(cell: CellFolder) -> None:
    cell.rig_data["keep_out"] = [{"kind": "sphere", "name": "lamp", "center_mm": [0, -60, 350], "radius_mm": 120}]
    shown = seen(cell, views=[TOP])
    assert shown.ended.code == 0, shown.ended.err
    assert "keep-out `lamp`" in shown.html
    assert red(shown.png) > 2000


def test_a_plan_that_cannot_be_read_ends_with_2(cell: CellFolder) -> None:
    cell.plan.write_text("schema_version: 1\nname: [")
    ended = cells.here("view", cell.plan, "--out", cell.folder / "out")
    assert ended.code == 2
    assert "plan.yaml:" in ended.err
    assert not (cell.folder / "out").exists()


def test_a_folder_that_cannot_be_made_ends_with_2(cell: CellFolder) -> None:
    (cell.folder / "taken").write_text("a file")
    ended = cells.here("view", cell.plan, "--out", cell.folder / "taken", "--no-paths")
    assert ended.code == 2
    assert "name another folder" in ended.err

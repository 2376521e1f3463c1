"""A new user's day at the console of a simulated cell, in a real browser: from a mesh to an archived run.

Each step's picture is kept for the docs, in the folder that COUPOLE_SCREENSHOTS names (`tools/make_screenshots`).
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cells
import pytest
from at_the_console import NARROW, WIDE, Visitor
from browser import Browser, needs_chromium
from cells import REPO, CellFolder
from PIL import Image
from served import Served, served

from sim.world.client import World

PASSWORD = "a long password"


class Day:
    """What all steps share."""

    def __init__(self, folder: Path, service: Served, world: World) -> None:
        self.folder, self.service, self.world = folder, service, world
        kept = os.environ.get("COUPOLE_SCREENSHOTS")
        self._pictures = Path(kept) if kept else folder / "pictures"
        self._taken = 0
        self.engineer = service.browser(token=service.token)
        for name, role in (("Ada", "operator"), ("Eve", "observer")):
            account = {"name": name, "password": PASSWORD, "role": role}
            assert self.engineer.post("/api/v1/accounts", account).status == 200
        self.visitor = self.comes()

    def comes(self) -> Visitor:
        visitor = Visitor(Browser(), self.service.url)
        visitor.resizes(WIDE)
        return visitor

    def picture(self, name: str, *, of_screen: bool = True) -> None:
        """Of this moment, which no serious barrier may mar; and the same on a telephone. Only on a screen may
        axe-core run."""
        self._taken += 1
        visitor = self.visitor
        visitor.picture(self._pictures / f"{self._taken:02d}-{name}.png")
        assert not of_screen or visitor.barriers() == []
        visitor.resizes(NARROW)
        assert visitor.fits(), f"{name}: {visitor.too_wide()}"
        visitor.resizes(WIDE)

    def state(self) -> dict[str, Any]:
        return self.engineer.state()

    def until(self, *states: str) -> dict[str, Any]:
        """The state, once it is one of these."""
        found: dict[str, Any] = cells.wait_until(
            lambda: now if (now := self.state())["state"] in states else None, f"{states}"
        )
        return found


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Day]:
    cell = CellFolder(tmp_path_factory.mktemp("day"), speed=0.4)
    cell.join()
    cell.write()
    with cell.world() as world, served(cell) as service:
        cell.plan.unlink()
        day = Day(cell.folder, service, world)
        try:
            yield day
        finally:
            day.visitor.driver.quit()


@pytest.mark.full
@needs_chromium
def test_a_day_at_the_console(day: Day) -> None:
    _signs_in(day)
    _writes_a_plan(day)
    _looks_at_the_object(day)
    _queues_two(day)
    _pauses(day)
    _loses_the_browser(day)
    _goes_on(day)
    _stops(day)
    _resumes(day)
    _looks_at_frames(day)
    _takes_a_view_again(day)
    _archives(day)
    _reads_the_report(day)


def _signs_in(day: Day) -> None:
    ada = day.visitor
    ada.goes_to("/plan")
    assert "Sign in" in ada.sees("h1, button")
    day.picture("sign-in")
    ada.types("#name", "Ada")
    ada.types("#password", "not this one")
    ada.clicks("button", "Sign in")
    ada.sees("#error", "wrong")
    ada.types("#password", PASSWORD)
    ada.clicks("button", "Sign in")
    ada.sees("h1", "Plan")


def _writes_a_plan(day: Day) -> None:
    ada = day.visitor
    ada.clicks("[data-name=new-plan]")
    ada.types("input[data-name=new-name]", "vase")
    ada.clicks("[data-name=make]")
    ada.sees("[data-name=verdict]", "can be run")
    _fills(ada, "object", "2019.17")
    shutil.copy(REPO / "configs/objects/relief.ply", day.folder / "relief.ply")
    _fills(ada, "mesh", "relief.ply")
    _fills(ada, "azimuths", "2")
    _fills(ada, "elevations", "60")
    _fills(ada, "every", "5")
    ada.clicks("[data-name=all-round]")
    _fills(ada, "budget", "0.01")
    ada.sees("[data-name=verdict]", "budget")
    day.picture("a-plan-refused")
    _fills(ada, "budget", "5")
    ada.sees("[data-name=verdict]", "can be run")
    _fills(ada, "exposures", "0")
    ada.sees("[data-name=problems]", "line")
    day.picture("a-mistake-at-its-line")
    _fills(ada, "exposures", "8000")
    ada.sees("[data-name=verdict]", "can be run")
    ada.clicks("[data-name=draw]")
    ada.sees(".cell img")
    day.picture("a-plan-drawn")
    ada.clicks("[data-name=save]")
    ada.is_told("saved")
    text = (day.folder / "vase.yaml").read_text()
    assert "azimuths_deg: [-90, 90]" in text
    assert "every: 5" in text


def _fills(visitor: Visitor, name: str, words: str) -> None:
    visitor.types(f"input[data-name={name}]", words + "\n")


def _looks_at_the_object(day: Day) -> None:
    ada, photograph = day.visitor, day.folder / "vase.png"
    Image.effect_noise((640, 480), 90).save(photograph)
    ada.goes_to("/object")
    ada.sees("[data-name=light]", "by the strictest of its plans")
    ada.at("input[data-name=photograph]").send_keys(str(photograph))
    ada.sees("[data-name=light]", "in its life")
    ada.at("img[src*=photograph]")
    _fills(ada, "amount", "0.25")
    _fills(ada, "note", "looked at by torch")
    ada.clicks("[data-name=enter-light]")
    ada.sees("[data-name=light]", "0.250 lux h")
    ada.at("[data-name=lies] img")
    day.picture("the-object")
    ada.goes_to("/plan")
    assert "looked at by torch (entered by Ada)" in (day.folder / "ledger/2019.17.jsonl").read_text()


def _queues_two(day: Day) -> None:
    """Behind a hold: while nothing runs, preflight is not put last."""
    ada = day.visitor
    ada.goes_to("/queue")
    ada.types("input[data-name=hold]", "put the vase on the support")
    ada.clicks("[data-name=enter-hold]")
    ada.sees("[data-name=halted]", "put the vase")
    for number in (1, 2):
        ada.clicks("[data-name=enter]")
        cells.wait_until(lambda: len(day.state()["queue"]) == number + 1, f"entry {number}")  # noqa: B023
    ada.sees("[data-name=sum]", "all that waits")
    day.picture("the-queue")
    ada.clicks("[data-name=go-on]")


def _pauses(day: Day) -> None:
    ada = day.visitor
    ada.goes_to("/run")
    day.until("running")
    ada.sees("dd", "/led")
    day.picture("a-run")
    ada.clicks("[data-name=pause]")
    day.until("paused")
    ada.sees("[data-name=state]", "paused: lights off, arm still")
    day.picture("paused")


def _loses_the_browser(day: Day) -> None:
    before = day.state()
    day.visitor.driver.quit()
    day.visitor = day.comes()
    day.visitor.signs_in("Ada", PASSWORD)
    assert "paused: lights off" in day.visitor.sees("[data-name=state]", "paused")
    assert day.state()["run"] == before["run"]


def _goes_on(day: Day) -> None:
    day.visitor.goes_to("/run")
    day.visitor.clicks("[data-name=pause]", "Go on")
    day.until("running")


def _stops(day: Day) -> None:
    ada = day.visitor
    ada.clicks("[data-name=stop]")
    ada.is_told("lights off")
    now = day.until("halted")
    assert [entry["state"] for entry in now["queue"]] == ["done", "stopped", "waiting"]
    assert cells.safe(day.world)
    ada.sees("[data-name=alarm]", "vase.yaml")
    day.picture("stopped")


def _resumes(day: Day) -> None:
    ada, stopped = day.visitor, day.state()["queue"][1]
    ada.goes_to("/queue")
    ada.clicks("[data-name=take-out]")
    cells.wait_until(lambda: len(day.state()["queue"]) == 2, "the second taken out")
    ada.goes_to("/run")
    ada.clicks("[data-name=resume]")
    resumed = cells.wait_until(lambda: _entry(day, resume=stopped["run"]), "the resume in the queue")
    assert resumed["needs"]["frames"] < stopped["needs"]["frames"]
    cells.wait_until(lambda: _entry(day, resume=stopped["run"])["state"] == "done", "the resumed run's end")
    cells.assert_each_shot_proven_once(Path(stopped["run"]))


def _entry(day: Day, **fields: str) -> dict[str, Any]:
    """The first entry of the queue with these fields; empty without one."""
    queue: list[dict[str, Any]] = day.state()["queue"]
    return next((one for one in queue if all(one[key] == value for key, value in fields.items())), {})


def _looks_at_frames(day: Day) -> None:
    ada, run = day.visitor, Path(day.state()["queue"][1]["run"]).name
    ada.goes_to("/runs")
    ada.sees("[data-name=runs]", run)
    day.picture("the-runs")
    ada.goes_to(f"/runs/{run}")
    ada.sees(".dome .scale", "of full scale")
    ada.clicks("[data-name=sheet] [data-shot]")
    ada.sees("[data-name=frame-facts]", "8 ms")
    day.picture("a-runs-frames")


def _takes_a_view_again(day: Day) -> None:
    ada = day.visitor
    day.until("idle")
    before = len(day.state()["queue"])
    ada.clicks("[data-name=retake]")
    cells.wait_until(lambda: len(day.state()["queue"]) > before, "the view in the queue")
    again = day.state()["queue"][-1]
    assert again["needs"]["frames"] * 2 == day.state()["queue"][1]["needs"]["frames"]


def _archives(day: Day) -> None:
    ada, run = day.visitor, Path(day.state()["queue"][1]["run"])
    size = sum(path.stat().st_size for path in run.glob("views/*.h5"))
    ada.clicks("[data-name=archive]")
    ada.clicks("[role=dialog] button", "Archive")
    ada.sees("[data-name=tasks] .state", "done")
    assert sum(path.stat().st_size for path in run.glob("views/*.h5")) < size
    cells.assert_each_shot_proven_once(run)


def _reads_the_report(day: Day) -> None:
    ada = day.visitor
    address = ada.at("[data-name=open-report]").get_attribute("href")
    assert address is not None
    assert address.startswith(ada.url)
    ada.driver.get(address)
    ada.sees("h1, h2", "Exposure")
    day.picture("the-report", of_screen=False)

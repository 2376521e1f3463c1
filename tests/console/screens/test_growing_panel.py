"""Normals, materials and their uncertainty grow on the run's screen, in a real browser, while the run goes on."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import pytest
from at_the_console import Visitor, assert_usable
from browser import Browser as Window
from browser import needs_chromium
from cells import CellFolder
from served import Browser, Served, served

PASSWORD = "a long password"
LEDS = 45
pytestmark = [needs_chromium, pytest.mark.timeout(900)]


@dataclass
class House:
    """A cell whose runs are processed, its console, and somebody before it."""

    cell: CellFolder
    served: Served
    operator: Browser
    ada: Visitor

    def run(self) -> str:
        return str(self.operator.state()["run"])

    def result(self) -> Path:
        return self.cell.run_folder.with_name(f"{self.cell.run_folder.name}-reflectance")

    def until(self, *states: str) -> dict[str, Any]:
        found: dict[str, Any] = cells.wait_until(
            lambda: now if (now := self.operator.state())["state"] in states else None, f"{states}"
        )
        return found


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    monkeypatch.syspath_prepend(str(cells.REPO / "tests/runs"))
    from beside_runs import cell_of_three_views

    cell = cell_of_three_views(tmp_path)
    with served(cell) as service:
        engineer = service.browser(token=service.token)
        made = engineer.post("/api/v1/accounts", {"name": "Ada", "password": PASSWORD, "role": "operator"})
        assert made.status == 200, made.text
        window = Window()
        try:
            ada = Visitor(window, service.url)
            ada.signs_in("Ada", PASSWORD)
            operator = service.browser(name="Ada", password=PASSWORD)
            house = House(cell, service, operator, ada)
            yield house
            if run := operator.state()["run"]:  # the test has failed; a paused run would stay for ever
                operator.post(f"/api/v1/runs/{run}/stop")
                house.until("halted", "idle")
        finally:
            window.driver.quit()


def hurried_worker() -> int:
    """The process beside the run, with a share of the machine."""
    from beside_runs import hurry, is_beside

    pids = cells.wait_until(
        lambda: [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit() and is_own(path)
                 and is_beside(int(path.name))],
        "the process beside the run",
    )  # fmt: skip
    assert len(pids) == 1
    cells.wait_until(lambda: os.sched_getscheduler(pids[0]) == os.SCHED_IDLE, "the lowest priority")
    hurry(pids[0])
    return int(pids[0])


def is_own(path: Path) -> bool:
    """A descendant of this process, and not of another worker's."""
    pid = int(path.name)
    try:
        while pid > 1 and pid != os.getpid():
            pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return False
    return pid == os.getpid()


def shown(ada: Visitor) -> list[dict[str, Any]]:
    """The pictures on the screen, once all are loaded."""
    read = (
        "[...document.querySelectorAll('.value-pictures img')].map(one => ({source: one.getAttribute('src'), "
        "words: one.alt, width: one.complete ? one.naturalWidth : 0}))"
    )
    found: list[dict[str, Any]] = cells.wait_until(
        lambda: one if (one := ada.browser.run(read)) and all(each["width"] for each in one) else None, "pictures"
    )
    return found


def frames_told(ada: Visitor) -> int:
    return int(ada.sees("[data-name=basis]", "frames").split("(")[1].split(" frames")[0].replace(",", ""))


def test_pictures_grow_while_the_run_goes_on_and_its_process_may_die(house: House) -> None:
    ada = house.ada
    ada.goes_to("/queue")
    ada.clicks("[data-name=reflectance]")
    ada.clicks("[data-name=enter]")
    ada.goes_to("/run")
    ada.sees("[data-name=beside]", "The processing")
    worker = hurried_worker()
    cells.wait_until(lambda: len(cells.events(house.cell.run_folder, "view")) == 2, "the second view")
    assert house.operator.post(f"/api/v1/runs/{house.run()}/pause").status == 200
    house.until("paused")
    assert "Drawn at" not in ada.at("[data-name=basis]").text or "first look" in ada.at("[data-name=basis]").text
    ada.sees("[data-name=basis]", "first look")
    first, few_frames = shown(ada), frames_told(ada)
    assert few_frames <= LEDS
    assert "in view" in first[0]["words"]
    assert "z is up" in first[0]["words"]
    ada.sees("[data-name=basis]", "result of")
    second, more_frames = shown(ada), frames_told(ada)
    assert "simulated" in ada.at("[data-name=basis]").text
    assert {one["source"] for one in first}.isdisjoint({one["source"] for one in second})
    assert more_frames > few_frames or "result of 1" in ada.at("[data-name=basis]").text
    assert "degrees" in second[1]["words"]
    assert "median" in ada.sees(".value-pictures", "Uncertainty of base colour")
    ada.sees("[data-name=relight-so-far]", "views")
    address = ada.at("[data-name=relight-so-far]").get_attribute("href")
    assert_usable(ada)
    refuses_other_files(house)
    says_what_is_missing(house)
    os.kill(worker, signal.SIGKILL)
    ada.sees("[data-name=beside]", "killed by signal 9")
    ada.sees("[data-name=beside]", "the run goes on without it")
    assert shown(ada), "the pictures stay"
    assert_usable(ada)
    assert house.operator.post(f"/api/v1/runs/{house.run()}/go-on").status == 200
    house.until("idle")
    (entry,) = house.operator.state()["queue"]
    assert entry["state"] == "done"
    cells.assert_each_shot_proven_once(house.cell.run_folder)
    assert address is not None
    ada.driver.get(address)
    ada.sees("body", "views so far")
    ada.at("canvas")
    assert ada.browser.troubles() == []
    ada.goes_to(f"/runs/{house.cell.run_folder.name}")
    ada.sees("[data-name=growing] [data-name=beside]", "This continues: coupole reflectance")
    assert_usable(ada)


def refuses_other_files(house: House) -> None:
    """Only whole pictures that the index names are served, and only to people who have signed in."""
    own, run = house.operator, house.run()
    address = f"/api/v1/runs/{run}/pictures-so-far"
    told = own.get(address).document
    name = told["of_views"][-1]["pictures"][0]["file"]
    (house.result() / "beside/pictures/0a0a0a0a-other.png").write_bytes(b"not drawn")
    for other in ("pictures.json", "0a0a0a0a-other.png", "..%2F..%2Fsamples.json", "..%2Fprogress.json"):
        assert own.get(f"{address}/{other}").status in (404, 422), other
    assert house.served.browser().get(f"{address}/{name}").status == 401
    reply = own.get(f"{address.replace(run, '..')}/{name}")
    assert reply.status in (404, 422)


def says_what_is_missing(house: House) -> None:
    """A picture that is half there or gone is told in words, and the others stay."""
    ada, before = house.ada, shown(house.ada)
    half, gone = (house.result() / "beside/pictures" / one["source"].rpartition("/")[2] for one in before[:2])
    kept = half.read_bytes(), gone.read_bytes()
    half.write_bytes(kept[0][:-9])
    gone.unlink()
    cells.wait_until(lambda: len(ada.all(".value-pictures img")) == len(before) - 2, "two pictures less")
    assert ada.sees(".value-pictures", "not complete").count("not complete") == 2
    half.write_bytes(kept[0])
    gone.write_bytes(kept[1])
    cells.wait_until(lambda: len(ada.all(".value-pictures img")) == len(before), "all pictures")
    lost = ada.at(".value-pictures img")
    ada.driver.execute_script("arguments[0].src = '/api/v1/runs/none/pictures-so-far/none.png'", lost)
    assert "not complete" in ada.sees(".value-pictures figure:first-child", "not complete")
    assert all("none.png" in trouble for trouble in ada.browser.troubles())


def test_a_run_without_it_says_so(house: House) -> None:
    ada = house.ada
    assert house.operator.post("/api/v1/queue", {"plan": "plan.yaml"}).status == 200
    ada.goes_to("/run")
    ada.sees("dd", "not requested for this run")
    assert not ada.at("[data-name=growing]").is_displayed()
    time.sleep(0.6)
    assert not ada.at("[data-name=growing]").is_displayed()
    house.until("idle")

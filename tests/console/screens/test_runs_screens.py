"""The console's screens of runs, calibrations and the system, in a real browser, with one finished run."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import h5py
import pytest
from at_the_console import Visitor, assert_usable
from browser import Browser as Window
from browser import needs_chromium
from cells import BLACK_DN, CellFolder
from selenium.webdriver.common.keys import Keys
from served import Browser, Served, served

PASSWORD = "a long password"
pytestmark = needs_chromium


@dataclass
class House:
    """A console with its people, one finished run, and somebody before it."""

    cell: CellFolder
    run: Path
    served: Served
    engineer: Browser
    ada: Visitor

    def led_frames(self) -> dict[int, Any]:
        """Pixels of each LED's frame, read with nothing but h5py."""
        with h5py.File(self.run / "views/top.h5") as file:
            detector = file["entry/instrument/detector"]
            data, frames = detector["data"][:], detector["frames"][:]
        found = {}
        for pixels, frame in zip(data, frames, strict=True):
            if b"/led" in frame["shot"]:
                found[int(frame["led"])] = pixels
        return found


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    cell = CellFolder(tmp_path_factory.mktemp("runs"))
    cell.write(lights={"kind": "every", "every": 40})
    assert cell.acquire().code == 0
    kinds = ("camera", "hand-eye", "flat-field")
    cell.rig_data["calibrations"] = [str(cells.REPO / f"configs/calibrations/{kind}.yaml") for kind in kinds]
    cell.write()
    with served(cell) as service:
        engineer = service.browser(token=service.token)
        for name, role in (("Ada", "operator"), ("Eve", "observer"), ("Grace", "engineer")):
            made = engineer.post("/api/v1/accounts", {"name": name, "password": PASSWORD, "role": role})
            assert made.status == 200, made.text
        engineer = service.browser(name="Grace", password=PASSWORD)
        window = Window()
        try:
            ada = Visitor(window, service.url)
            ada.signs_in("Ada", PASSWORD)
            yield House(cell, cell.run_folder, service, engineer, ada)
        finally:
            window.driver.quit()


def leds_above_the_support() -> dict[int, tuple[float, float, float]]:
    """Positions, mm, as the shipped rig places its support: under the arm's base, which hangs upside down."""
    text = (cells.REPO / "configs/domes/coupole.csv").read_text()
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        int(row["id"]): (float(row["x_mm"]) - 200, -float(row["y_mm"]), 1450 - float(row["z_mm"])) for row in rows
    }


def next_above(shown: dict[int, tuple[float, float, str]], led: int) -> int:
    """Where the arrow up leads from an LED on the dome: near, and not much aside."""
    x, y, _ = shown[led]
    ways = {
        other: y - far_y + 2.5 * abs(far_x - x)
        for other, (far_x, far_y, _) in shown.items()
        if other != led and y - far_y > 1e-6
    }
    return min(ways, key=ways.__getitem__)


# -- runs -----------------------------------------------------------------------------------------------------


def test_a_run_is_found_and_verified_in_the_table(house: House) -> None:
    ada, name = house.ada, house.run.name
    ada.goes_to("/runs")
    ada.sees("[data-name=runs]", name)
    ada.types("[data-name=search]", "nothing like it")
    ada.sees("[data-name=count]", "0 of 1 runs")
    ada.types("[data-name=search]", "relief done")
    ada.sees("[data-name=count]", "1 of 1 runs")
    ada.clicks("[data-run]", "Actions")
    ada.clicks("[data-name=verify]")
    ada.sees("[data-name=tasks] .state", "done")
    table = ada.sees("td[data-head=verified]", "20")
    assert "no" not in table
    ada.clicks("[data-name=close]")
    assert_usable(ada)


def test_nothing_is_archived_before_somebody_says_so(house: House) -> None:
    ada = house.ada
    ada.goes_to(f"/runs/{house.run.name}")
    before = (house.run / "views/top.h5").stat().st_ino
    ada.clicks("[data-name=archive]")
    ada.sees("[role=dialog]", "read back and compared")
    assert ada.barriers() == []
    ada.clicks("[data-name=cancel]")
    ada.clicks("[data-name=export]")
    ada.sees("[role=dialog]", "on this machine")
    ada.clicks("[data-name=cancel]")
    assert (house.run / "views/top.h5").stat().st_ino == before
    tasks = ada.sees("[data-name=tasks]", "verify")
    assert "archive" not in tasks
    assert "export" not in tasks


def test_the_dome_is_coloured_by_the_frames_means_and_leads_to_them(house: House) -> None:
    ada = house.ada
    ada.goes_to(f"/runs/{house.run.name}")
    ada.sees(".dome .scale", "of full scale")
    frames = house.led_frames()
    shown = {
        int(shot.split("/led")[1][:4]): (float(x), float(y), title)
        for shot, x, y, title in ada.browser.run(
            "[...document.querySelectorAll('.dome circle[data-shot]')].map(one => [one.dataset.shot, "
            "one.getAttribute('cx'), one.getAttribute('cy'), one.querySelector('title').textContent])"
        )
    }
    assert sorted(shown) == sorted(frames)
    for led, pixels in frames.items():
        share = (pixels.mean() - BLACK_DN) / (4095 - BLACK_DN)
        assert shown[led][2] == f"LED {led}: {share:.1%} of full scale"
    for led, (x, y, z) in leds_above_the_support().items():
        if led in shown:
            far = 1 - math.atan2(z, math.hypot(x, y)) / (math.pi / 2)
            assert math.hypot(*shown[led][:2]) == pytest.approx(far, abs=1e-3)
            assert math.atan2(-shown[led][1], shown[led][0]) == pytest.approx(math.atan2(y, x), abs=1e-2)
    chosen = sorted(frames)[7]
    ada.clicks(f".dome circle[data-shot='top/led{chosen:04d}/e0']")
    ada.sees("[data-name=frame]", f"LED {chosen} ")
    ada.presses(Keys.ARROW_UP)
    above = int(ada.sees("[data-name=sheet] [aria-current]", f"LED {next_above(shown, chosen)}").split()[1])
    assert shown[above][1] < shown[chosen][1]
    ada.clicks("[data-name=next]")
    ada.sees("[data-name=frame]", f"LED {sorted(frames)[sorted(frames).index(above) + 1]} ")
    ada.presses(Keys.ARROW_LEFT)
    ada.sees("[data-name=frame]", f"LED {above} ")
    ada.clicks("[data-name=sheet] [data-shot]", f"LED {sorted(frames)[0]}")
    ada.sees("[data-name=frame]", f"LED {sorted(frames)[0]} ")
    facts = ada.sees("[data-name=frame-facts]", "exposure")
    assert "8 ms" in facts
    ada.sees("[data-name=events]", "view top is finished")
    assert_usable(ada)


def test_a_report_is_shown_without_a_right_to_anything(house: House) -> None:
    eve = house.served.browser(name="Eve", password=PASSWORD)
    page = eve.get(f"/api/v1/runs/{house.run.name}/report")
    assert page.status == 200
    assert "Exposure" in page.text
    policy = page.headers["Content-Security-Policy"]
    assert "sandbox" in policy
    assert "script" not in policy
    assert "default-src 'none'" in policy
    assert eve.get(f"/api/v1/runs/{house.run.name}/look").status == 422, "nobody has made it"
    assert eve.get("/api/v1/runs/..%2F..%2Fetc/report").status in (404, 422)
    assert house.served.browser().get(f"/api/v1/runs/{house.run.name}/report").status == 401


# -- calibrations ---------------------------------------------------------------------------------------------


def test_records_in_force_and_what_they_refuse_are_told(house: House) -> None:
    ada = house.ada
    ada.goes_to("/calibration")
    rows = ada.sees("[data-name=records]", "hand-eye").splitlines()
    assert any(row.startswith("dark") and "none in force" in row for row in rows)
    camera = next(row for row in rows if row.startswith("camera"))
    assert "128 x 96" in camera, "it holds for larger frames"
    plans = ada.sees("[data-name=plans]", "plan.yaml")
    assert "128 x 96" in plans
    ada.sees("[data-name=steps]", "On the support: a grey card.")
    assert not ada.at("[data-name=new-campaign]").is_enabled(), "Ada is no engineer"
    assert_usable(ada)


# -- the system -----------------------------------------------------------------------------------------------


def test_an_engineer_keeps_people_and_makes_a_bundle(house: House) -> None:
    ada, engineer = house.ada, house.engineer
    ada.goes_to("/system")
    ada.sees("[data-name=disk]", "room for")
    assert ada.all("[data-name=people]") == []
    assert not ada.at("[data-name=make-bundle]").is_enabled()
    ada.signs_out()
    ada.signs_in("Grace", PASSWORD)
    ada.goes_to("/system")
    ada.sees("[data-name=people]", "Eve")
    ada.chooses("[data-name=role-Eve]", "operator")
    ada.sees("[data-name=log]", "make Eve operator")
    roles = {one["name"]: one["role"] for one in engineer.get("/api/v1/accounts").document}
    assert roles == {"Ada": "operator", "Eve": "operator", "Grace": "engineer"}
    ada.clicks("[data-name=remove-Grace]")
    ada.clicks("[role=dialog] [data-name=yes]")
    ada.is_told("last engineer")
    ada.clicks(".q-notification.bg-negative button")
    ada.clicks("[data-name=make-bundle]")
    name = ada.sees("[data-name=bundle]", "zip")
    path = f"/api/v1/support-bundles/{name}"
    assert house.served.browser(name="Ada", password=PASSWORD).get(path).status == 403
    ada.types("[data-name=search-log]", "bundle")
    assert "make Eve" not in ada.sees("[data-name=log]", "support bundle")
    assert_usable(ada)

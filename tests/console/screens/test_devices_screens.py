"""The console's screens of the devices, in a real browser, before a simulated cell."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path

import cells
import numpy as np
import pytest
from at_the_console import WIDE, Visitor, assert_usable
from bench_room import PASSWORD, Room, kill_browser
from browser import Browser as Window
from browser import needs_chromium
from busy_machine import slowness
from cells import CellFolder
from ruamel.yaml import YAML
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from served import served

HOME_DEG = [0.0, -170.0, 150.0, 0.0, -70.0, 0.0]
PARK_DEG = [60.0, -170.0, 150.0, 0.0, -70.0, 0.0]
BUDGET_LUX_H = 0.06
EXPOSURE_MS = 8.0
pytestmark = needs_chromium


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    """A held button is renewed within 300 ms of the world's time: the world is as slow as the machine is busy."""
    cell = CellFolder(tmp_path_factory.mktemp("devices"), speed=0.5 / slowness())
    cell.rig_data["console"] = {"at_the_cell": ["127.0.0.1"]}
    cell.rig_data["motion"]["park_joints_deg"] = PARK_DEG
    cell.plan_data["object"]["dose_budget_lux_h"] = BUDGET_LUX_H
    cell.join()
    with cell.world() as world, served(cell) as service:
        engineer = service.browser(token=service.token)
        account = {"name": "Ada", "password": PASSWORD, "role": "operator"}
        assert engineer.post("/api/v1/accounts", account).status == 200
        window = Window()
        found = Room(cell, world, service, engineer, Visitor(window, service.url))
        try:
            found.ada.resizes(WIDE)
            found.ada.signs_in("Ada", PASSWORD)
            found.ada.goes_to("/devices")
            found.opened()
            yield found
        finally:
            found.ada.driver.quit()


# -- devices --------------------------------------------------------------------------------------------------


def test_open_devices_are_told_and_test_themselves(room: Room) -> None:
    ada = room.ada
    ada.goes_to("/devices")
    assert f"port {room.world.endpoints['ledbox']['port']}" in ada.sees("[data-name=device-ledbox]", "SIM-0001")
    for kind in ("LED box", "camera", "arm"):
        ada.sees(f".device[aria-label='{kind}: open']")
    assert room.engineer.state()["lent_to"] == "Ada: the devices are open"
    for kind in ("ledbox", "robot"):
        ada.clicks(f"[data-name=test-{kind}]")
        ada.sees(f"[data-name=report-{kind}]", "Test passed")
    assert room.bench()["state"]["devices"]["ledbox"]["self_test"]["passed"]
    assert "not reported by this controller" in ada.sees("[data-name=arm]"), "RSI does not tell"
    assert_usable(ada)


def test_a_path_is_seen_before_it_can_be_driven(room: Room) -> None:
    ada = room.ada
    ada.goes_to("/devices")
    ada.sees("[data-name=joints]", "-170.0")
    assert not ada.at("[data-name=drive]").is_enabled()
    room.chooses("to", "park")
    ada.clicks("[data-name=show-path]")
    ada.sees("[data-name=path]", "To park: one straight motion")
    way = ada.browser.run("document.querySelectorAll('.arm-picture .way').length")
    assert way == 2, "from the front and from above"
    assert np.allclose(room.joints_deg(), HOME_DEG, atol=0.01), "showing moves nothing"
    assert_usable(ada)
    ada.clicks("[data-name=drive]")
    ada.sees("[data-name=path]", "The arm is at park.")
    assert np.allclose(room.joints_deg(), PARK_DEG, atol=0.01)
    ada.sees("[data-name=joints]", "60.0")
    assert not ada.at("[data-name=drive]").is_enabled(), "a path is good for once"
    room.chooses("to", "view top")
    ada.clicks("[data-name=show-path]")
    ada.sees("[data-name=path]", "To view top")
    room.chooses("to", "home")
    ada.sees("[data-name=path]", "First look")
    ada.clicks("[data-name=show-path]")
    ada.sees("[data-name=path]", "To home")
    ada.clicks("[data-name=drive]")
    ada.sees("[data-name=path]", "The arm is at home.")
    assert np.allclose(room.joints_deg(), HOME_DEG, atol=0.01)


def test_a_button_moves_the_arm_as_long_as_it_is_held(room: Room) -> None:
    ada = room.ada
    ada.goes_to("/devices")
    ada.sees("[data-name=joints]")
    ada.sees("[data-name=enabling-switch]", "no enabling switch")
    room.holds("A1")
    ada.sees("[data-name=hand-said]", "is held")
    ActionChains(ada.driver, duration=20).release().perform()
    rested = room.at_rest()
    assert rested["joints_deg"][0] < 25.0, "the step itself goes farther"
    ada.sees("[data-name=hand-said]", "released")
    time.sleep(0.3)
    assert np.allclose(room.joints_deg(), rested["joints_deg"], atol=0.01)
    cells.wait_until(
        lambda: any("hold ends: the button was released" in line for line in room.logged()), "the log"
    )
    assert room.logged().count("hold begins to move A1 +") == 1, "renewals are not logged"


def test_a_key_holds_as_the_pointer_does_and_a_hidden_page_lets_go(room: Room) -> None:
    ada = room.ada
    ada.goes_to("/devices")
    ada.sees("[data-name=joints]")
    before = room.joints_deg()

    def press() -> None:
        ada.driver.execute_script("document.querySelector(\"[data-axis=A1][data-direction='-1']\").focus()")
        ActionChains(ada.driver).key_down(Keys.SPACE).perform()

    room.keeps(press, lambda: ActionChains(ada.driver).key_up(Keys.SPACE).perform())
    assert room.joints_deg()[0] < before[0]
    ada.driver.execute_script(
        "Object.defineProperty(document, 'hidden', {value: true});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    rested = room.at_rest()
    ada.sees("[data-name=hand-said]", "the page was hidden")
    ActionChains(ada.driver).key_up(Keys.SPACE).perform()
    assert np.allclose(room.joints_deg(), rested["joints_deg"], atol=0.05)


def test_nobody_else_holds_the_arm(room: Room) -> None:
    """The connection is refused without a session, and to who only looks."""
    import asyncio

    import websockets

    url = room.served.url.replace("http", "ws") + "/api/v1/bench/hold"

    async def asked(cookie: str, origin: str) -> str:
        headers = {"Cookie": cookie, "Origin": origin}
        async with websockets.connect(url, additional_headers=headers) as socket:
            await socket.send(json.dumps({"axis": "A1", "direction": 1, "share": 1.0}))
            return str(json.loads(await socket.recv()).get("ended", "moves"))

    account = {"name": "Eve", "password": PASSWORD, "role": "observer"}
    assert room.engineer.post("/api/v1/accounts", account).status == 200
    eve = room.served.browser(name="Eve", password=PASSWORD)
    assert "only for operators" in asyncio.run(asked(eve.cookie, room.served.url))
    for cookie, origin in (("", room.served.url), (eve.cookie, "http://elsewhere.example")):
        with pytest.raises(websockets.exceptions.InvalidStatus):
            asyncio.run(asked(cookie, origin))
    assert not room.world.ask("state")["arm_moving"]


def test_renewals_that_are_sent_in_advance_hold_nothing(room: Room) -> None:
    """2,000 at once, as a program that is not the page might send them; the connection stays open."""
    import websockets.sync.client

    url = room.served.url.replace("http", "ws") + "/api/v1/bench/hold"
    cookies = "; ".join(f"{one['name']}={one['value']}" for one in room.ada.driver.get_cookies())
    headers = {"Cookie": cookies, "Origin": room.served.url}
    press = {"axis": "A1", "direction": 1, "share": 0.1}
    with websockets.sync.client.connect(url, additional_headers=headers) as button:
        with contextlib.suppress(websockets.exceptions.ConnectionClosed):  # the console ends it meanwhile
            for request in (press, *[{**press, "renew": "0"}] * 2000):
                button.send(json.dumps(request))
        answers = [json.loads(button.recv(cells.PATIENCE_S))]
        while "ended" not in answers[-1]:
            answers.append(json.loads(button.recv(cells.PATIENCE_S)))
        cells.wait_until(lambda: not room.world.ask("state")["arm_moving"], "the arm at rest")
    assert [list(answer) for answer in answers] == [["state", "renew"], ["ended"]], answers
    assert "sent before it is void" in answers[-1]["ended"]


# -- focus and expose -----------------------------------------------------------------------------------------


def at_focus(room: Room, lights: str = "500, 700") -> Visitor:
    ada = room.ada
    ada.goes_to("/focus")
    ada.sees("[data-name=bench]", "are open")
    ada.types("input[data-name=leds]", lights)
    return ada


def expose(ada: Visitor) -> None:
    shown = ada.sees("[data-name=picture]")
    ada.clicks("[data-name=expose]")
    cells.wait_until(lambda: ada.sees("[data-name=picture]") != shown, "another picture")


def test_a_picture_under_two_leds_and_its_light(room: Room) -> None:
    ada = at_focus(room)
    before_s = [room.lit_s(led) for led in (500, 700)]
    dose = room.bench()["state"]["dose"]
    ada.clicks("[data-name=expose]")
    words = ada.sees("[data-name=picture]", "LED 500, LED 700, 8 ms")
    for led, before in zip((500, 700), before_s, strict=True):
        assert EXPOSURE_MS <= 1000 * (room.lit_s(led) - before) < 1.5 * EXPOSURE_MS
    given = room.bench()["state"]["dose"]["total_lux_h"] - dose["total_lux_h"]
    assert given > 0
    said = ada.sees("[data-name=exposed]", "this picture gave")
    assert f"{given:.5f} lux h" in said
    shown = "document.querySelector('.look-picture').naturalWidth"
    cells.wait_until(lambda: (ada.browser.run(shown) or 0) > 0, "the picture")
    lit = ada.browser.run("[...document.querySelectorAll('.led-chooser circle')].map(one => one.dataset.led)")
    assert sorted(lit) == ["500", "700"]
    assert words.startswith("Picture ")
    ada.driver.execute_script("document.querySelector('.led-chooser').scrollIntoView({block: 'center'})")
    ActionChains(ada.driver, duration=20).move_to_element(
        ada.at(".led-chooser [data-led='700']")
    ).click().perform()
    cells.wait_until(lambda: ada.at("input[data-name=leds]").get_attribute("value") == "500", "one LED")


def test_a_region_is_drawn_looked_into_and_made_white(room: Room) -> None:
    ada = at_focus(room, "500")
    ada.types("input[data-name=exposure]", "60")
    expose(ada)
    look = ada.at("[data-name=look]")
    ActionChains(ada.driver, duration=20).move_to_element_with_offset(
        look, -100, -80
    ).click_and_hold().move_by_offset(200, 160).release().perform()
    fields = [f"input[data-name=region-{side}]" for side in ("x", "y", "width", "height")]
    cells.wait_until(lambda: all(ada.at(field).get_attribute("value") for field in fields), "a region")
    region = [int(ada.at(field).get_attribute("value") or 0) for field in fields]
    width = look.size["width"] / 128  # pixels of the screen for each of the sensor's
    assert region == pytest.approx([64 - 100 / width, 48 - 80 / width, 200 / width, 160 / width], abs=2)
    expose(ada)
    ada.sees("[data-name=best]", "of the region")
    ada.clicks("[data-name=white]")
    expose(ada)
    ada.sees("[data-name=white-words]", "R, G, B times")
    assert "1.000, 1.000, 1.000" not in ada.sees("[data-name=white-words]")
    ActionChains(ada.driver, duration=20).move_to_element(look).click().perform()
    ada.sees("[data-name=loupe]", "128 x 96 px of picture")
    cells.wait_until(
        lambda: ada.browser.run("document.querySelector('.loupe img').naturalWidth") == 128, "the loupe's picture"
    )
    assert_usable(ada)


def test_the_metered_exposure_is_put_into_the_plan(room: Room) -> None:
    ada = at_focus(room, "500")
    ada.clicks("[data-name=meter]")
    ada.clicks("[data-name=yes]")
    ada.sees("[data-name=advice]", "view top")
    work = room.bench()["state"]["work"]
    assert (work["kind"], work["state"]) == ("meter", "done")
    assert YAML(typ="safe", pure=True).load(room.cell.plan)["exposure"] == {"kind": "fixed", "exposure_us": 8000}
    ada.clicks("[data-name=put]")
    ada.is_told("plan.yaml has")
    assert YAML(typ="safe", pure=True).load(room.cell.plan)["exposure"] == work["exposure"]
    assert YAML(typ="safe", pure=True).load(room.cell.plan)["object"]["id"] == "relief"


def test_live_pictures_end_at_a_stop_and_light_beyond_the_budget_is_refused(room: Room) -> None:
    ada = at_focus(room, "500")
    ada.types("input[data-name=exposure]", "1")
    ada.clicks("[data-name=live]")
    first = ada.sees("[data-name=picture]", "Picture")
    cells.wait_until(lambda: ada.sees("[data-name=picture]") != first, "the next picture by itself")
    ada.clicks("[data-name=stop]")
    assert "Live is off: stopped" in ada.sees("[data-name=picture]", "Live is off")
    lit_s = room.lit_s(500)
    time.sleep(0.4)
    assert room.lit_s(500) == lit_s
    assert any("live pictures end: " in line and "lux h" in line for line in room.logged())
    ada.types("input[data-name=exposure]", "1900")
    ada.clicks("[data-name=live]")
    ada.sees("[data-name=refused]", "budget")
    ada.sees("[data-name=picture]", "Live is off: a picture was refused")
    lit_s = room.lit_s(500)
    time.sleep(0.4)
    assert room.lit_s(500) == lit_s
    assert 0 <= room.bench()["state"]["dose"]["total_lux_h"] <= BUDGET_LUX_H


# -- what ends it ---------------------------------------------------------------------------------------------


def test_a_browser_that_is_killed_while_it_holds_stops_the_arm(room: Room) -> None:
    room.ada.goes_to("/devices")
    room.ada.sees("[data-name=joints]")
    room.holds("A1")
    before = room.world.ask("state")
    kill_browser(room.ada)
    rested = room.at_rest()
    assert rested["t_s"] - before["t_s"] < 2.0, "its death, 0.3 s, and the braking"
    assert abs(rested["joints_deg"][0] - before["joints_deg"][0]) < 30.0
    cells.wait_until(lambda: room.bench()["state"]["work"]["state"] == "done", "the end of the hold")
    assert room.bench()["phase"] == "open", "the devices stay open"


def test_the_devices_are_closed_before_the_queue_begins_a_plan(room: Room) -> None:
    taken = room.engineer.post("/api/v1/control/take")
    assert taken.status == 200, taken.text
    room.engineer.post("/api/v1/queue", {"hold": "look"})
    cells.wait_until(lambda: room.engineer.state()["halted"] or room.bench()["phase"] == "closed", "the queue")
    cells.wait_until(lambda: room.bench()["phase"] == "closed", "closed devices")
    assert "hold: look begins" in room.bench()["closed_because"]
    assert cells.safe(room.world)
    assert room.engineer.state()["lent_to"] == ""
    assert not Path(str(room.engineer.state()["run"])).exists()

"""Two people at one console, each in a real browser; and what a stop there does in the world."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cells
import pytest
from at_the_console import Visitor
from browser import Browser, needs_chromium
from cells import CellFolder
from served import Served, served

from sim.world.client import World

PASSWORD = "a long password"
STOPS_WITHIN_S = 0.2
"""On the world's clock."""
pytestmark = needs_chromium


@dataclass
class Two:
    """A console before a world that outlives the runs; Ada and Max are operators."""

    cell: CellFolder
    world: World
    service: Served
    ada: Visitor
    max: Visitor

    def state(self) -> dict[str, Any]:
        return self.service.browser(name="Ada", password=PASSWORD).state()

    def begins(self) -> dict[str, Any]:
        """A run gives light."""
        asked = self.service.browser(name="Ada", password=PASSWORD)
        assert asked.post("/api/v1/queue/go-on").status == 200
        assert asked.post("/api/v1/queue", {"plan": self.cell.plan.name, "now": True}).status == 200
        found: dict[str, Any] = cells.wait_until(
            lambda: now if (now := self.state())["proven"] > 20 else None, "a run"
        )
        return found


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Two]:
    cell = CellFolder(tmp_path_factory.mktemp("two"), speed=0.5)
    cell.join()
    cell.write(lights={"kind": "every", "every": 3}, object={"id": "relief"})
    with cell.world() as world, served(cell) as service:
        engineer = service.browser(token=service.token)
        for name in ("Ada", "Max"):
            account = {"name": name, "password": PASSWORD, "role": "operator"}
            assert engineer.post("/api/v1/accounts", account).status == 200
        windows = [Browser(), Browser()]
        try:
            ada, other = (Visitor(window, service.url) for window in windows)
            ada.signs_in("Ada", PASSWORD)
            other.signs_in("Max", PASSWORD)
            yield Two(cell, world, service, ada, other)
        finally:
            for window in windows:
                window.driver.quit()


def test_one_acts_the_other_watches_until_control_is_handed_over(two: Two) -> None:
    for visitor in (two.ada, two.max):
        visitor.goes_to("/queue")
    _holds(two.ada, "clean the disk")
    assert two.state()["in_control"] == "Ada"
    two.max.sees("[data-name=waiting], [data-name=halted]", "clean the disk")
    _holds(two.max, "drink coffee")
    two.max.sees(".q-notification", "Ada is in control")
    assert not any("coffee" in entry["hold"] for entry in two.state()["queue"])
    two.max.clicks("[data-name=person]")
    two.max.clicks("[data-name=take]", "Ask for control")
    two.ada.clicks("[data-name=person]")
    two.ada.clicks("[data-name=give]", "Give control to Max")
    cells.wait_until(lambda: two.state()["in_control"] == "Max", "Max in control")
    two.ada.goes_to("/queue")
    two.max.goes_to("/queue")
    _holds(two.ada, "open the window")
    two.ada.sees(".q-notification", "Max is in control")
    _holds(two.max, "drink coffee")
    cells.wait_until(lambda: any("coffee" in entry["hold"] for entry in two.state()["queue"]), "Max's hold")
    two.max.clicks("[data-name=person]")
    two.max.clicks("[data-name=give]")
    cells.wait_until(lambda: two.state()["in_control"] == "", "nobody in control")


def _holds(visitor: Visitor, words: str) -> None:
    visitor.types("[data-name=hold]", words)
    visitor.clicks("[data-name=enter-hold]")


def test_a_stop_by_who_watches_puts_the_light_out_at_once(two: Two) -> None:
    _empty(two)
    two.begins()
    two.max.goes_to("/queue")
    two.max.sees("[data-name=state]", "running")
    pressed_s = float(two.world.ask("state")["t_s"])
    two.max.clicks("[data-name=stop]")
    last_s = _last_light(two)
    two.max.sees(".q-notification", "lights off")
    assert cells.safe(two.world)
    assert last_s - pressed_s < STOPS_WITHIN_S
    two.max.sees("[data-name=alarm]", "stopped")


def _last_light(two: Two) -> float:
    """When light was last given, by the world's clock, once none has been for a while."""
    given, last_s, now_s = -1.0, 0.0, 0.0
    while now_s < last_s + 3 * STOPS_WITHIN_S:
        light, now_s = two.world.ask("light"), float(two.world.ask("state")["t_s"])
        total = sum(float(seconds) for seconds in _values(light["leds_s"]))
        if total > given:
            given, last_s = total, now_s
    return last_s


def _values(leds_s: Any) -> list[float]:
    return list(leds_s.values()) if isinstance(leds_s, dict) else list(leds_s)


def test_a_killed_acquisition_leaves_a_dark_cell_and_is_offered_to_be_resumed(two: Two) -> None:
    now = two.begins()
    running = next(entry for entry in now["queue"] if entry["state"] == "running")
    os.kill(running["pid"], signal.SIGKILL)
    cells.wait_until(lambda: cells.safe(two.world), "a dark cell, and an arm at rest")
    two.ada.goes_to("/run")
    two.ada.sees("[data-name=alarm]", "killed")
    two.ada.clicks("[data-name=resume]")
    resumed = (
        cells.wait_until(
            lambda: next((one for one in two.state()["queue"] if one["resume"] == running["run"]), None),
            "the resume",
        )
        if running["run"]
        else None
    )
    assert resumed is not None
    two.ada.sees("[data-name=state]", "running")
    two.ada.clicks("[data-name=stop]")
    two.ada.sees("[data-name=alarm]", "stopped")


def _empty(two: Two) -> None:
    asked = two.service.browser(name="Ada", password=PASSWORD)
    for entry in asked.state()["queue"]:
        if entry["state"] == "waiting":
            assert asked.post(f"/api/v1/queue/{entry['id']}", method="DELETE").status == 200

"""A room for tests of the devices at the console: a simulated cell, its console, and somebody before it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cells
import numpy as np
import psutil
from at_the_console import Visitor
from cells import CellFolder
from selenium.webdriver.common.action_chains import ActionChains
from served import Browser, Served

from sim.world.client import World

PASSWORD = "a long password"


@dataclass
class Room:
    """A world, the console of its cell with the devices open, and somebody before it."""

    cell: CellFolder
    world: World
    served: Served
    engineer: Browser
    ada: Visitor

    def joints_deg(self) -> np.ndarray:
        return np.array(self.world.ask("state")["joints_deg"])

    def at_rest(self) -> dict[str, Any]:
        found: dict[str, Any] = cells.wait_until(
            lambda: not (state := self.world.ask("state"))["arm_moving"] and state, "the arm at rest"
        )
        return found

    def lit_s(self, led: int) -> float:
        return float(self.world.ask("light")["leds_s"].get(str(led), 0.0))

    def bench(self) -> dict[str, Any]:
        found: dict[str, Any] = self.engineer.get("/api/v1/bench").document
        return found

    def logged(self) -> list[str]:
        """What people have done, by the audit log."""
        log = next(self.cell.folder.rglob("audit.jsonl")).read_text().splitlines()
        return [line["asked"] for line in map(json.loads, log)]

    def chooses(self, name: str, value: str) -> None:
        self.ada.at(f"[data-name={name}] option[value='{value}']")
        self.ada.driver.execute_script(
            "const one = document.querySelector(`[data-name=${arguments[0]}]`); one.value = arguments[1];"
            "one.dispatchEvent(new Event('change', {bubbles: true}))",
            name,
            value,
        )

    def holds(self, axis: str) -> None:
        """Press the pointer on a button and keep it there, until the arm is under way."""
        button = self.ada.at(f"[data-axis={axis}][data-direction='1']")
        self.ada.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        self.keeps(
            lambda: ActionChains(self.ada.driver, duration=20).click_and_hold(button).perform(),
            lambda: ActionChains(self.ada.driver, duration=20).release().perform(),
        )

    def keeps(self, press: Callable[[], None], release: Callable[[], None]) -> None:
        """Press until the arm is under way; anew where a hold has ended because a busy machine renewed it late."""
        before = self.joints_deg()

        def under_way() -> bool:
            if np.abs(self.joints_deg() - before).max() > 1.0:
                return True
            if self.ada.at("[data-name=hand-said]").text.startswith(("stopped", "released")):
                release()
                press()
            return False

        press()
        cells.wait_until(under_way, "the arm under way")

    def opened(self) -> None:
        self.ada.sees("[data-name=bench]", "closed")
        self.chooses("object-plan", "plan.yaml")
        self.ada.clicks("[data-name=open]")
        self.ada.sees("[data-name=bench]", "The devices are open; the object of plan.yaml lies on the support.")


def kill_browser(visitor: Visitor) -> None:
    """As a crash of the machine before which somebody sits: nothing can be said any more."""
    driver = psutil.Process(visitor.driver.service.process.pid)
    for process in driver.children(recursive=True):
        process.kill()

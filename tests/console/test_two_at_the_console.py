"""Two people at one console, each in a real browser; and what a stop there does in the world."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cells
import numpy as np
import pytest
from at_the_console import Visitor, assert_usable
from browser import Browser, needs_chromium
from cells import CellFolder
from served import BORROWER, Served, served

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


class Watch:
    """Looks at a world as often as it can: this machine's time, the world's, and the light that was given until
    then."""

    def __init__(self, world: World) -> None:
        self._world, self._ended = world, threading.Event()
        self._seen: list[tuple[float, float, float]] = []
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._ended.is_set():
            before_s = time.time()
            light, state = self._world.ask("light"), self._world.ask("state")
            given_s = sum(map(float, light["leds_s"].values()))
            self._seen.append(((before_s + time.time()) / 2, float(state["t_s"]), given_s))
            time.sleep(0.002)

    def until_dark(self) -> None:
        """Until no light was given for three times as long as a stop may take."""
        cells.wait_until(lambda: self._seen[-1][1] - self._last_light_s() > 3 * STOPS_WITHIN_S, "no more light")

    def _last_light_s(self) -> float:
        """The world's time at which light was last seen to have been given."""
        return next((one[1] for one in self._seen if one[2] >= self._seen[-1][2]), 0.0)

    def light_after(self, machine_s: float) -> float:
        """Time on the world's clock from a moment on this machine's until no light was given any more."""
        machine, world = [one[0] for one in self._seen], [one[1] for one in self._seen]
        return self._last_light_s() - float(np.interp(machine_s, machine, world))


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Two]:
    cell = CellFolder(tmp_path_factory.mktemp("two"), speed=0.5)
    cell.join()
    cell.write(lights={"kind": "every", "every": 3}, repeats=5, object={"id": "relief"})  # longer than all looks
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
    two.max.is_told("Ada is in control")
    assert not any("coffee" in entry["hold"] for entry in two.state()["queue"])
    two.max.clicks("[data-name=person]")
    two.max.clicks("[data-name=take]", "Ask for control")
    two.ada.clicks("[data-name=person]")
    two.ada.clicks("[data-name=give]", "Give control to Max")
    cells.wait_until(lambda: two.state()["in_control"] == "Max", "Max in control")
    two.ada.goes_to("/queue")
    two.max.goes_to("/queue")
    _holds(two.ada, "open the window")
    two.ada.is_told("Max is in control")
    _holds(two.max, "drink coffee")
    cells.wait_until(lambda: any("coffee" in entry["hold"] for entry in two.state()["queue"]), "Max's hold")
    _holds(two.max, 'x" :title="window.hacked = 1" b="')
    two.max.sees("[data-name=waiting]", "window.hacked")
    assert two.max.browser.run("window.hacked") is None, "words of a person are only words"
    two.max.clicks("[data-name=person]")
    two.max.clicks("[data-name=give]")
    cells.wait_until(lambda: two.state()["in_control"] == "", "nobody in control")


def test_whatever_the_cell_is_lent_for_is_interrupted_by_the_headers_stop(two: Two) -> None:
    command = [sys.executable, "-c", BORROWER, str(two.cell.rig)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=cells.REPO
    ) as borrower:
        assert borrower.stdout is not None
        assert borrower.stdout.readline() == "mine\n"
        cells.wait_until(lambda: two.state()["lent_to"], "the loan")
        two.max.clicks("[data-name=stop]")
        assert borrower.wait(cells.PATIENCE_S) == -signal.SIGINT
    cells.wait_until(lambda: not two.state()["lent_to"], "the end of the loan")


SCREENS = (("/run", "No run"), ("/queue", "coffee"), ("/plan", "can be run"), ("/object", "lux h"))


@pytest.mark.parametrize(("path", "shows"), SCREENS)
def test_screens_are_usable_small_and_in_the_dark(two: Two, path: str, shows: str) -> None:
    two.ada.goes_to(path)
    two.ada.sees("main", shows)
    assert_usable(two.ada)


def _holds(visitor: Visitor, words: str) -> None:
    visitor.types("[data-name=hold]", words)
    visitor.clicks("[data-name=enter-hold]")


def test_a_stop_by_who_watches_puts_the_light_out_at_once(two: Two) -> None:
    _empty(two)
    two.begins()
    two.max.goes_to("/queue")
    two.max.sees("[data-name=state]", "running")
    two.max.driver.execute_script(
        "addEventListener('pointerdown', () => { window.pressed_s = Date.now() / 1000; }, {capture: true})"
    )
    with Watch(two.world) as watch:
        two.max.clicks("[data-name=stop]")
        two.max.is_told("lights off")
        watch.until_dark()
    assert cells.safe(two.world)
    pressed_s = float(two.max.browser.run("window.pressed_s"))
    assert watch.light_after(pressed_s) < STOPS_WITHIN_S
    two.max.sees("[data-name=alarm]", "stopped")


@pytest.mark.full  # without a browser: tests/console/plans/test_plan_queue.py
def test_a_run_that_does_not_answer_is_said_to_be_silent_and_stopped(two: Two) -> None:
    _empty(two)
    now = two.begins()
    running = next(entry for entry in now["queue"] if entry["state"] == "running")
    os.kill(running["pid"], signal.SIGSTOP)
    try:
        two.max.sees("[data-name=state]", "the run does not answer")
        cells.wait_until(lambda: _is_dark(two.world), "the devices' own watchdogs")
        two.max.clicks("[data-name=stop]")
        two.max.is_told("perhaps not stopped yet: the run does not answer")
    finally:
        os.kill(running["pid"], signal.SIGCONT)
    cells.wait_until(lambda: two.state()["state"] == "halted", "the end of its process")


@pytest.mark.full  # over HTTP: tests/console/command_line/test_command_line.py
def test_a_killed_acquisition_leaves_a_dark_cell_and_is_offered_to_be_resumed(two: Two) -> None:
    _empty(two)
    now = two.begins()
    running = next(entry for entry in now["queue"] if entry["state"] == "running")
    os.kill(running["pid"], signal.SIGKILL)
    cells.wait_until(lambda: cells.safe(two.world), "a dark cell, and an arm at rest")
    two.ada.goes_to("/run")
    two.ada.sees("[data-name=alarm]", "killed")
    two.ada.clicks("[data-name=resume]")
    cells.wait_until(lambda: any(one["resume"] for one in two.state()["queue"]), "the resume")
    two.ada.sees("[data-name=state]", "running")
    two.ada.clicks("[data-name=stop]")
    two.ada.sees("[data-name=alarm]", "stopped")


def _is_dark(world: World) -> bool:
    state = world.ask("state")
    return not (state["shining"] or state["panels"] or state["arm_moving"])


def _empty(two: Two) -> None:
    cells.wait_until(lambda: two.state()["state"] in ("idle", "halted"), "nothing runs")
    asked = two.service.browser(name="Ada", password=PASSWORD)
    for entry in asked.state()["queue"]:
        if entry["state"] == "waiting":
            assert asked.post(f"/api/v1/queue/{entry['id']}", method="DELETE").status == 200

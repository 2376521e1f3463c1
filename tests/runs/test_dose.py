"""The light on the object: what the ledger of a real cell holds, whatever ends the session, against the account of
the world at the other end of the wires."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import cells
import numpy as np
import pytest
from cells import CellFolder
from forks import fork_context
from real_cells import HOME, real_cell, true_dose_lux_h

from coupole.acquisition import burst_runner, looking
from coupole.storage.ledger import Ledger
from coupole.storage.ledger_lines import History
from coupole.viewing import live
from sim.world.client import World

QUARTZ = 1e-4
"""The box's seconds are its own quartz's."""
BRACKET = {"kind": "bracket", "exposures_us": [2000, 8000]}


@dataclass
class RealCell:
    """A cell whose object has received light before: what counts is what is added."""

    cell: CellFolder
    world: World
    before_lux_h: float = 0.0
    true_before_lux_h: np.ndarray = field(default_factory=lambda: np.zeros(9))

    def mark(self, **plan: Any) -> None:
        """Write the plan again, and count from now on."""
        self.cell.write(
            **{"views": [HOME], "lights": cells.SOME_LIGHTS, "exposure": BRACKET, "object": RELIEF, **plan}
        )
        Ledger(Path(self.cell.rig_data["ledger"]), "relief").set_budget(1e6, "an operator")
        self.before_lux_h = self.history.total_lux_h
        self.true_before_lux_h = true_dose_lux_h(self.cell, self.world)

    @property
    def history(self) -> History:
        return Ledger(Path(self.cell.rig_data["ledger"]), "relief").read_history()

    @property
    def entered_lux_h(self) -> float:
        return self.history.total_lux_h - self.before_lux_h

    @property
    def true_lux_h(self) -> float:
        """At the point that has received most since."""
        return float((true_dose_lux_h(self.cell, self.world) - self.true_before_lux_h).max())

    @property
    def lit_s(self) -> float:
        return float(sum(self.world.ask("light")["leds_s"].values()))


LONGEST_FLASH_S = 0.02
"""Of the live view at its default exposure."""
RELIEF = {"id": "relief", "mesh": str(cells.COARSE_RELIEF)}


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCell]:
    with real_cell(tmp_path_factory.mktemp("real")) as (cell, world):
        yield RealCell(cell, world)


@pytest.fixture
def real(opened: RealCell) -> RealCell:
    opened.mark()
    return opened


def foreseen_lux_h(cell: CellFolder) -> float:
    found: float = cells.here("check", cell.plan, "--no-paths", "--json").document["dose_lux_h"]
    return found


def test_the_ledger_holds_what_preflight_foresaw_and_the_lamps_gave_and_its_plan_came_first(
    real: RealCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[float, float, int]] = []
    table_box = burst_runner.table_box

    def watched(box: Any) -> Any:
        start = vars(box).setdefault("unwatched", box.start)

        def looks_first(table: Any) -> None:
            run = max((real.cell.folder / "storage").glob("2*"))
            above_lux_h = real.entered_lux_h - real.true_lux_h
            seen.append((above_lux_h, real.history.unsettled_lux_h, len(cells.events(run, "begin"))))
            start(table)

        box.start = looks_first
        return table_box(box)

    monkeypatch.setattr(burst_runner, "table_box", watched)
    ended = real.cell.acquire()
    assert ended.code == 0, ended.err
    assert real.true_lux_h > 0.03
    assert real.entered_lux_h == pytest.approx(real.true_lux_h, rel=QUARTZ)
    assert real.entered_lux_h == pytest.approx(ended.document["dose_lux_h"], rel=1e-6)
    assert real.entered_lux_h == pytest.approx(foreseen_lux_h(real.cell), rel=1e-6)
    run = Path(ended.document["run"])
    assert real.history.of_run(run.name).total_lux_h == pytest.approx(real.entered_lux_h)
    assert cells.here("status", run, "--json").document["dose_lux_h"] == pytest.approx(real.true_lux_h, rel=QUARTZ)
    assert len(seen) == 2
    for number, (above, planned, begun) in enumerate(seen, 1):
        assert planned > 0
        assert above == pytest.approx(planned, abs=1e-5), "the plan of this burst stands in the ledger, no other"
        assert begun == number, "and in the journal"


@pytest.mark.full
def test_a_panel_counts_for_as_long_as_it_is_on(real: RealCell) -> None:
    real.mark(lights={"kind": "panels", "panels": [1]}, exposure={"kind": "fixed", "exposure_us": 8000})
    ended = real.cell.acquire()
    assert ended.code == 0, ended.err
    assert real.true_lux_h > 0.01
    assert real.true_lux_h <= real.entered_lux_h * (1 + QUARTZ)
    assert real.entered_lux_h < 1.5 * real.true_lux_h


@pytest.mark.full
def test_metering_enters_its_light(real: RealCell) -> None:
    ended = cells.here("meter", real.cell.plan, "--yes", "--json")
    assert ended.code == 0, ended.err
    assert real.true_lux_h > 0
    assert real.entered_lux_h == pytest.approx(real.true_lux_h, rel=QUARTZ)
    assert real.history.of_run("meter").total_lux_h == pytest.approx(real.entered_lux_h)


def test_the_devices_self_tests_give_no_light(real: RealCell) -> None:
    assert cells.here("devices", "--rig", real.cell.rig).code == 0
    assert real.true_lux_h == 0


def test_a_ledger_that_cannot_be_written_is_found_before_any_light(real: RealCell) -> None:
    place = real.cell.rig_data["ledger"]
    real.cell.rig_data["ledger"] = str(real.cell.plan)
    try:
        real.cell.write()
        assert real.cell.acquire().code == 6
    finally:
        real.cell.rig_data["ledger"] = place
    assert real.true_lux_h == 0


# -- the live view -----------------------------------------------------------------------------------------------


class Viewer:
    """Somebody at the page of a live view in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._url = ""
        serve = looking.serve

        def served(*arguments: Any) -> Any:
            server = serve(*arguments)
            self._url = server.url
            return server

        monkeypatch.setattr(looking, "serve", served)

    def look(self) -> bool:
        """Once; True."""
        with urlopen(cells.wait_until(lambda: self._url, "the page") + "figures", timeout=cells.PATIENCE_S):
            return True


def live_view(real: RealCell, behaves: Callable[[], object]) -> cells.Ended:
    """`coupole live` under LED 500, while someone `behaves` in another thread and then says Ctrl-C."""
    failed: list[BaseException] = []

    def work() -> None:
        try:
            behaves()
        except BaseException as error:  # noqa: BLE001  raised below
            failed.append(error)
        os.kill(os.getpid(), signal.SIGINT)

    person = threading.Thread(target=work)
    person.start()
    ended = cells.here("live", real.cell.plan, "--led", "500", "--fps", "20", "--yes")
    person.join()
    if failed:
        raise failed[0]
    return ended


def test_live_enters_its_light_and_gives_none_while_no_page_is_open(
    real: RealCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "UNWATCHED_S", 0.5)
    viewer, begun_s = Viewer(monkeypatch), real.lit_s

    def behaves() -> None:
        cells.wait_until(lambda: viewer.look() and real.true_lux_h > 0, "light")
        assert real.history.unsettled_lux_h > 0
        dark_at_s = wait_for_the_dark(real.world, 1.0)
        cells.wait_until(lambda: viewer.look() and real.lit_s > dark_at_s, "light again")

    ended = live_view(real, behaves)
    assert ended.code == 0, ended.err
    assert "no page is open: the light is off" in ended.err
    flash_lux_h = real.true_lux_h * LONGEST_FLASH_S / (real.lit_s - begun_s)
    assert 0 <= real.entered_lux_h * (1 + QUARTZ) - real.true_lux_h <= flash_lux_h, "one that Ctrl-C forestalled"
    assert real.history.unsettled_lux_h == 0


def test_live_stops_at_the_objects_budget_and_does_not_begin_beyond_it(
    real: RealCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = Viewer(monkeypatch)
    left_lux_h = 0.02
    real.mark(object={**RELIEF, "dose_budget_lux_h": real.history.total_lux_h + left_lux_h})
    begun_s = real.lit_s
    ended_s = threading.Event()

    def looks_on() -> None:
        while not ended_s.wait(0.1):
            with contextlib.suppress(OSError):  # it has ended
                viewer.look()

    watching = threading.Thread(target=looks_on)
    watching.start()
    try:
        ended = cells.here(
            "live", real.cell.plan, "--led", "500", "--exposure-us", "20000", "--fps", "20", "--yes"
        )
    finally:
        ended_s.set()
        watching.join()
    assert ended.code == 3, ended.err
    assert "would exceed its budget" in ended.err
    flashes = (real.lit_s - begun_s) / 0.0212
    assert flashes > 5
    assert left_lux_h - 1.01 * real.true_lux_h / flashes < real.true_lux_h <= left_lux_h
    assert real.entered_lux_h == pytest.approx(real.true_lux_h, rel=QUARTZ)
    real.mark(object={**RELIEF, "dose_budget_lux_h": real.history.total_lux_h})
    ended = cells.here("live", real.cell.plan, "--led", "500", "--yes")
    assert ended.code == 3
    assert "its budget is" in ended.err
    assert real.true_lux_h == 0


# -- whatever ends the session -----------------------------------------------------------------------------------


def test_an_interrupted_burst_counts_as_far_as_it_may_have_come(real: RealCell) -> None:
    real.mark(lights={"kind": "every", "every": 6}, exposure={"kind": "fixed", "exposure_us": 8000})

    def interrupts() -> None:
        begun_s = real.lit_s
        cells.wait_until(lambda: real.lit_s > begun_s + 0.3, "some light")
        os.kill(os.getpid(), signal.SIGINT)

    person = threading.Thread(target=interrupts)
    person.start()
    ended = real.cell.acquire()
    person.join()
    assert ended.code == 130, ended.err
    assert real.true_lux_h <= real.entered_lux_h * (1 + QUARTZ)
    assert real.history.unsettled_lux_h == 0
    resumed = real.cell.acquire("--resume", ended.document["run"])
    assert resumed.code == 0, resumed.err
    assert real.true_lux_h <= real.entered_lux_h * (1 + QUARTZ)
    assert resumed.document["dose_lux_h"] == pytest.approx(real.entered_lux_h, rel=1e-6), "of all sessions"


def _acquire(plan: Path, silence: Path) -> None:
    """In a process of its own: `coupole acquire`."""
    fd = os.open(silence, os.O_WRONLY | os.O_CREAT)
    os.dup2(fd, 1)
    os.dup2(fd, 2)
    sys.exit(cells.here("acquire", plan, "--yes").code)


def test_killed_at_any_moment_the_ledger_is_never_below_and_at_most_a_burst_above(
    real: RealCell, scale: Callable[[int, int], int]
) -> None:
    random = np.random.default_rng(scale(3, 4))
    lit_s = 54 * (0.0092 + 0.0032)
    for _ in range(scale(2, 50)):
        at_s = real.lit_s + random.uniform(0, lit_s)
        acquiring = fork_context().Process(target=_acquire, args=(real.cell.plan, real.cell.folder / "said.txt"))
        acquiring.start()

        def is_the_moment(at_s: float = at_s, running: Any = acquiring) -> bool:
            return real.lit_s >= at_s or not running.is_alive()

        cells.wait_until(is_the_moment, "the moment to kill")
        acquiring.kill()
        acquiring.join()
        wait_for_the_dark(real.world, 0.2)
        real.world.ask("reset_robot")
        run = max((real.cell.folder / "storage").glob("2*"))
        planned_lux_h = [np.max(event["planned_lux_h"]) for event in cells.events(run, "begin")]
        assert -1e-5 <= real.entered_lux_h - real.true_lux_h <= 1.001 * max(planned_lux_h, default=0.0)
        told = cells.here("status", run, "--json").document["dose_lux_h"]
        assert real.true_lux_h <= told * (1 + QUARTZ)
        assert told <= real.history.of_run(run.name).total_lux_h + 1e-6
        real.mark()


def wait_for_the_dark(world: World, seconds: float) -> float:
    """Until no light has been given for so long; returns all that was. A box without its host goes on until its
    table or watchdog ends it."""

    def still_dark() -> bool:
        light, begun_s = world.ask("light"), world.ask("state")["t_s"]
        cells.wait_until(lambda: world.ask("state")["t_s"] > begun_s + seconds, "a moment of the world's time")
        return bool(world.ask("light") == light)

    cells.wait_until(still_dark, "the dark")
    return float(sum(world.ask("light")["leds_s"].values()))


@pytest.mark.full
def test_a_box_that_is_lost_in_a_burst_leaves_the_whole_burst_in_the_ledger(tmp_path: Path) -> None:
    """It goes on flashing until its watchdog trips, and nobody hears of it."""
    with real_cell(tmp_path, lights={"kind": "every", "every": 4}) as (cell, world):
        real = RealCell(cell, world)
        world.ask("fault", fault={"kind": "cut_wire", "at_edge": 30})
        assert cell.acquire().code == 4
        wait_for_the_dark(world, 0.2)
        assert real.true_lux_h <= real.entered_lux_h * (1 + QUARTZ)
        assert real.history.unsettled_lux_h == real.entered_lux_h


@pytest.mark.full
def test_shots_taken_again_do_not_exceed_the_budget(tmp_path: Path) -> None:
    with real_cell(tmp_path) as (cell, world):
        real = RealCell(cell, world)
        budget = 1.05 * foreseen_lux_h(cell)
        cell.write(object={**RELIEF, "dose_budget_lux_h": budget})
        for frame in range(20, 40):
            world.ask("fault", fault={"kind": "lost_transfer", "frame": frame})
        ended = cell.acquire()
        assert ended.code == 3, ended.err
        assert "would exceed its budget" in ended.document["error"]
        assert 0.9 * budget < real.true_lux_h <= budget
        assert real.entered_lux_h == pytest.approx(real.true_lux_h, rel=QUARTZ)


@pytest.mark.full
def test_a_cell_of_single_flashes_enters_them_too(tmp_path: Path) -> None:
    with real_cell(tmp_path, text_box=True) as (cell, world):
        real = RealCell(cell, world)
        ended = cell.acquire()
        assert ended.code == 0, ended.err
        assert 0 < real.true_lux_h <= real.entered_lux_h
        assert real.history.unsettled_lux_h == 0


# -- simulated cells ---------------------------------------------------------------------------------------------


def test_earlier_light_from_elsewhere_counts_against_the_budget(cell: CellFolder) -> None:
    cell.write(object={**RELIEF, "dose_budget_lux_h": 121.0})
    assert cells.here("check", cell.plan, "--no-paths", "--json").document["refusals"] == []
    cells.here("dose", "relief", "--rig", cell.rig, "--add", "121", "--note", "photographed in 2019")
    ended = cell.acquire()
    assert ended.code == 3
    assert "after 121.00 lux.h before; its budget is 121 lux.h" in ended.document["error"]

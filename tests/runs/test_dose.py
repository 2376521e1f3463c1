"""The light on the object: what the ledger of a real cell holds, whatever ends the session, against the account of
the world at the other end of the wires."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import CellFolder
from real_cells import real_cell, true_dose_lux_h

from coupole.acquisition import burst_runner
from coupole.storage.ledger import History, Ledger
from sim.world.client import World

QUARTZ = 1e-4
"""The box's seconds are its own quartz's."""
BRACKET = {"kind": "bracket", "exposures_us": [2000, 8000]}


def history(cell: CellFolder) -> History:
    return Ledger(Path(cell.rig_data["ledger"]), "relief").read()


def expected_lux_h(cell: CellFolder) -> float:
    found: float = cells.here("check", cell.plan, "--no-paths", "--json").document["dose_lux_h"]
    return found


def test_the_ledger_of_a_real_cell_holds_what_preflight_foresaw_and_the_lamps_gave(tmp_path: Path) -> None:
    with real_cell(tmp_path, exposure=BRACKET) as (cell, world):
        ended = cell.acquire()
        assert ended.code == 0, ended.err
        given, true = history(cell), true_dose_lux_h(cell, world)
    assert true > 0.03
    assert given.total_lux_h == pytest.approx(true, rel=QUARTZ)
    assert given.total_lux_h == pytest.approx(ended.document["dose_lux_h"], rel=1e-6)
    assert given.total_lux_h == pytest.approx(expected_lux_h(cell), rel=1e-6)
    assert (given.runs, given.unsettled_lux_h) == ([cell.run_folder.name], 0.0)
    assert cells.here("status", cell.run_folder, "--json").document["dose_lux_h"] == pytest.approx(
        true, rel=QUARTZ
    )


def test_a_panel_counts_for_as_long_as_it_is_on(tmp_path: Path) -> None:
    with real_cell(tmp_path, lights={"kind": "panels", "panels": [1, 2]}) as (cell, world):
        ended = cell.acquire()
        assert ended.code == 0, ended.err
        given, true = history(cell).total_lux_h, true_dose_lux_h(cell, world)
    assert true > 0.01
    assert true <= given * (1 + QUARTZ)
    assert given < 1.5 * true


def test_a_cell_of_single_flashes_enters_them_too(tmp_path: Path) -> None:
    with real_cell(tmp_path, text_box=True) as (cell, world):
        ended = cell.acquire()
        assert ended.code == 0, ended.err
        given, true = history(cell), true_dose_lux_h(cell, world)
    assert true > 0
    assert true <= given.total_lux_h
    assert given.unsettled_lux_h == 0


def test_metering_enters_its_light(tmp_path: Path) -> None:
    with real_cell(tmp_path) as (cell, world):
        ended = cells.here("meter", cell.plan, "--yes", "--json")
        assert ended.code == 0, ended.err
        given, true = history(cell), true_dose_lux_h(cell, world)
    assert true > 0
    assert given.total_lux_h == pytest.approx(true, rel=QUARTZ)
    assert given.runs == ["meter"]


def test_the_plan_of_a_burst_is_on_disk_before_its_light(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[float, float, int]] = []
    table_box = burst_runner.table_box

    with real_cell(tmp_path, exposure=BRACKET) as (cell, world):

        def watched(box: Any) -> Any:
            start = type(box).start

            def looks_first(table: Any) -> None:
                given, true = history(cell), true_dose_lux_h(cell, world)
                begun = len(cells.events(cell.run_folder, "begin"))
                seen.append((given.total_lux_h - true, given.unsettled_lux_h, begun))
                start(box, table)

            box.start = looks_first
            return table_box(box)

        monkeypatch.setattr(burst_runner, "table_box", watched)
        assert cell.acquire().code == 0
    assert len(seen) == 2
    for number, (above, planned, begun) in enumerate(seen, 1):
        assert planned > 0
        assert above == pytest.approx(planned, abs=1e-5), "the plan of this burst stands in the ledger, no other"
        assert begun == number, "and in the journal"


def test_the_devices_self_tests_give_no_light(tmp_path: Path) -> None:
    with real_cell(tmp_path) as (cell, world):
        assert cells.here("devices", "--rig", cell.rig).code == 0
        assert world.ask("light") == {"leds_s": {}, "panels_s": {}}


# -- budget ------------------------------------------------------------------------------------------------------


def test_a_ledger_that_cannot_be_written_is_found_before_any_light(tmp_path: Path) -> None:
    with real_cell(tmp_path) as (cell, world):
        Path(cell.rig_data["ledger"]).write_text("no folder")
        assert cell.acquire().code == 6
        assert world.ask("light") == {"leds_s": {}, "panels_s": {}}


def test_shots_taken_again_do_not_exceed_the_budget(tmp_path: Path) -> None:
    with real_cell(tmp_path) as (cell, world):
        budget = 1.05 * expected_lux_h(cell)
        cell.write(object={**cell.plan_data["object"], "dose_budget_lux_h": budget})
        for edge in range(20, 40):
            world.ask("fault", fault={"kind": "lost_transfer", "frame": edge})
        ended = cell.acquire()
        true = true_dose_lux_h(cell, world)
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
    assert ended.code == 3, ended.err
    assert "would exceed its budget" in ended.document["error"]
    assert 0.9 * budget < true <= budget
    assert history(cell).total_lux_h == pytest.approx(true, rel=QUARTZ)


def test_earlier_light_from_elsewhere_counts_against_the_budget(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write(object={**cell.plan_data["object"], "dose_budget_lux_h": 121.0})
    assert cells.here("check", cell.plan, "--no-paths", "--json").document["refusals"] == []
    cells.here("dose", "relief", "--rig", cell.rig, "--add", "121", "--note", "photographed in 2019")
    ended = cell.acquire()
    assert ended.code == 3
    assert "after 121.00 lux.h before; its budget is 121 lux.h" in ended.document["error"]


# -- whatever ends the session -----------------------------------------------------------------------------------


def test_a_box_that_is_lost_in_a_burst_leaves_the_whole_burst_in_the_ledger(tmp_path: Path) -> None:
    """It goes on flashing until its watchdog trips, and nobody hears of it."""
    with real_cell(tmp_path, lights={"kind": "every", "every": 4}) as (cell, world):
        world.ask("fault", fault={"kind": "cut_wire", "at_edge": 30})
        assert cell.acquire().code == 4
        wait_for_the_dark(world)
        given, true = history(cell), true_dose_lux_h(cell, world)
    assert true <= given.total_lux_h * (1 + QUARTZ)
    assert given.unsettled_lux_h == given.total_lux_h


def test_an_interrupted_burst_counts_as_far_as_it_may_have_come(tmp_path: Path) -> None:
    with real_cell(tmp_path, lights={"kind": "every", "every": 4}) as (cell, world):
        acquiring = cell.start_acquire()
        cells.wait_until(lambda: sum(world.ask("light")["leds_s"].values()) > 0.3, "some light")
        acquiring.send_signal(signal.SIGINT)
        assert cells.finish(acquiring).code == 130
        given, true = history(cell), true_dose_lux_h(cell, world)
        whole = expected_lux_h(cell)
        assert true <= given.total_lux_h * (1 + QUARTZ)
        assert given.total_lux_h < true + 0.2 * whole
        assert given.unsettled_lux_h == 0
        resumed = cell.acquire("--resume", cell.run_folder)
        assert resumed.code == 0, resumed.err
        given, true = history(cell), true_dose_lux_h(cell, world)
    assert true <= given.total_lux_h * (1 + QUARTZ)
    assert resumed.document["dose_lux_h"] == pytest.approx(given.total_lux_h, rel=1e-6), "of all sessions"


def _acquire(plan: Path, silence: Path) -> None:
    """In a process of its own: `coupole acquire`."""
    fd = os.open(silence, os.O_WRONLY | os.O_CREAT)
    os.dup2(fd, 1)
    os.dup2(fd, 2)
    sys.exit(cells.here("acquire", plan, "--yes").code)


def test_killed_at_any_moment_the_ledger_is_never_below_and_at_most_a_burst_above(
    tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    random = np.random.default_rng(scale(3, 4))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cells", "coupole.acquisition.session", "coupole.preflight.job"])
    with real_cell(tmp_path, exposure=BRACKET) as (cell, world):
        burst = 1.001 * expected_lux_h(cell) * 8.2 / (8.2 + 2.2)  # the longer exposure's share, 200 us of margin
        lit_s = 54 * (0.0092 + 0.0032)
        before = 0.0
        for _ in range(scale(3, 50)):
            at_s = sum(world.ask("light")["leds_s"].values()) + random.uniform(0, lit_s)
            acquiring = context.Process(target=_acquire, args=(cell.plan, tmp_path / "said.txt"))
            acquiring.start()
            cells.wait_until(
                lambda at_s=at_s, run=acquiring: (
                    sum(world.ask("light")["leds_s"].values()) >= at_s or not run.is_alive()
                ),
                "the moment to kill",
            )
            acquiring.kill()
            acquiring.join()
            wait_for_the_dark(world)
            world.ask("reset_robot")
            above = history(cell).total_lux_h - true_dose_lux_h(cell, world)
            assert -1e-5 <= above - before <= burst, (random, above, before)
            before = above
        for run in sorted((tmp_path / "storage").glob("2*")):
            told = cells.here("status", run, "--json").document["dose_lux_h"]
            assert told == pytest.approx(history(cell).of_run(run.name).total_lux_h, abs=1e-6)


def wait_for_the_dark(world: World) -> None:
    """Until no light has been given for a while: a box without its host goes on until its table or watchdog ends
    it."""

    def still_dark() -> bool:
        light, begun_s = world.ask("light"), world.ask("state")["t_s"]
        cells.wait_until(lambda: world.ask("state")["t_s"] > begun_s + 0.2, "a moment of the world's time")
        return bool(world.ask("light") == light)

    cells.wait_until(still_dark, "the dark")


# -- simulated cells ---------------------------------------------------------------------------------------------


def test_a_simulated_run_counts_its_light_but_enters_none(cell: CellFolder) -> None:
    ended = cell.acquire()
    assert ended.document["dose_lux_h"] == pytest.approx(expected_lux_h(cell), rel=1e-6)
    assert not (cell.folder / "ledger").exists()


def test_a_light_before_the_burst_is_told_in_the_journal(cell: CellFolder) -> None:
    assert cell.acquire().code == 0
    kinds = [event["event"] for event in cells.events(cell.run_folder) if event["event"] in ("begin", "burst")]
    assert kinds == ["begin", "burst"]
    begun, ended = (cells.events(cell.run_folder, kind)[0] for kind in ("begin", "burst"))
    assert ended["given_lux_h"] == pytest.approx(begun["planned_lux_h"], rel=1e-6)
    assert max(ended["given_lux_h"]) == pytest.approx(expected_lux_h(cell), rel=1e-6)
    about = json.loads((cell.run_folder / "run.json").read_text())
    assert about["simulated"] is True

"""Preflight of what is entered: as quick as other processes, told to who waits, and can be given up."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.console.plans.entry_preflight import BESIDE_A_RUN, EntryPreflight
from coupole.console.processes.warm_process import WarmProcess
from coupole.errors import InputError
from coupole.preflight.files import Files


@pytest.fixture(scope="module")
def preflight() -> Iterator[EntryPreflight]:
    found = EntryPreflight()
    yield found
    found.close()


def test_it_says_what_check_says_and_all_that_is_wrong(tmp_path: Path, preflight: EntryPreflight) -> None:
    cell = CellFolder(tmp_path)
    assert not preflight.of(Files(cell.plan), "Ada", beside_a_run=False).problems
    assert preflight._process.step == "computing paths, heat, light and time"
    cell.write(object={**cell.plan_data["object"], "dose_budget_lux_h": 0.01})
    found = preflight.of(Files(cell.plan), "Ada", beside_a_run=False)
    checked = cells.here("check", cell.plan, "--json").document
    assert [problem.message for problem in found.problems] == checked["refusals"]
    assert found.document["dose_lux_h"] == checked["dose_lux_h"]
    cell.write(exposure={"kind": "fixed"}, lights={"kind": "sometimes"})
    wrong = preflight.of(Files(cell.plan), "Ada", beside_a_run=False).problems
    assert len(wrong) == 2
    assert all(problem.line for problem in wrong)
    assert preflight.words == ""


def test_one_that_takes_long_is_told_and_given_up_and_the_next_is_made(
    tmp_path: Path, preflight: EntryPreflight
) -> None:
    os.kill(preflight._process.run(os.getpid, 60.0), signal.SIGSTOP)
    said: list[str] = []

    def ask() -> None:
        with pytest.raises(InputError, match="was ended") as refused:
            preflight.of(Files(tmp_path / "slow.yaml"), "Ada", beside_a_run=False)
        said.append(str(refused.value))

    thread = threading.Thread(target=ask)
    thread.start()
    cells.wait_until(lambda: preflight.words.endswith(" UTC: it begins"), "its step")
    assert preflight.words.startswith("slow.yaml, entered by Ada at ")
    preflight.give_up()
    thread.join(cells.PATIENCE_S)
    assert said
    with pytest.raises(InputError, match="no preflight"):
        preflight.give_up()
    cell = CellFolder(tmp_path)
    assert not preflight.of(Files(cell.plan), "Ada", beside_a_run=False).problems


def test_it_is_put_behind_others_only_beside_a_run_and_then_mildly() -> None:
    process, own = WarmProcess("computes"), os.getpriority(os.PRIO_PROCESS, 0)
    try:
        for niceness in (0, BESIDE_A_RUN, 0):
            assert process.run(os.getpriority, 60.0, niceness, os.PRIO_PROCESS, 0) == own + niceness
        assert 0 < BESIDE_A_RUN < 10
    finally:
        process.end()

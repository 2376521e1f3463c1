"""The queue's file and the thread that runs it, where the disk or the machine do not do what they are asked."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cells
import pytest
from cells import CellFolder

from coupole.acquisition.cell_marks import in_use
from coupole.acquisition.runtime_folder import named_after
from coupole.console.cell import acquisitions as module
from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.state_now import _entries_now
from coupole.console.people.accounts import Accounts, Role
from coupole.console.people.sessions import Control
from coupole.console.plans import plan_queue
from coupole.console.plans.plan_queue import PlanQueue
from coupole.errors import InputError, StorageError
from coupole.plan.cell import read_cell


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[str]]]:
    """Command lines of the processes that were begun; they end at once, well."""
    found: list[list[str]] = []
    processes: list[subprocess.Popen[bytes]] = []

    def popen(command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        found.append(command)
        processes.append(subprocess.Popen(["true"], **options))
        return processes[-1]

    monkeypatch.setattr(module, "subprocess", SimpleNamespace(Popen=popen, DEVNULL=subprocess.DEVNULL))
    yield found
    for process in processes:
        process.wait()


@pytest.fixture
def queue(tmp_path: Path) -> PlanQueue:
    return PlanQueue(tmp_path / "queue.json")


@pytest.fixture
def running(queue: PlanQueue, tmp_path: Path) -> Iterator[Acquisitions]:
    cell = read_cell(CellFolder(tmp_path).rig)
    with Acquisitions(queue, cell, tmp_path / "output") as found:
        yield found


def test_a_plan_is_begun_once_with_the_cells_rig(
    queue: PlanQueue, begun: list[list[str]], running: Acquisitions, tmp_path: Path
) -> None:
    queue.add("Ada", plan="one.yaml")
    queue.add("Ada", hold="change the object")
    queue.add("Ada", plan="two.yaml")
    cells.wait_until(lambda: queue.halt_reason, "the hold")
    assert [entry.state for entry in queue.entries] == ["done", "done", "waiting"]
    queue.go_on()
    cells.wait_until(lambda: queue.entries[2].state == "done", "the second plan")
    assert [command[4:7] for command in begun] == [
        [name, "--rig", str(tmp_path / "rig.yaml")] for name in ("one.yaml", "two.yaml")
    ]
    assert [entry.state for entry in PlanQueue(tmp_path / "queue.json").entries] == ["done"] * 3


def test_a_queue_that_cannot_be_written_begins_nothing(
    queue: PlanQueue, begun: list[list[str]], running: Acquisitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue.add("Ada", plan="one.yaml")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plan_queue, "write_synced", full)
    queue._kept = queue._kept.model_copy(update={"halted": ""})
    cells.wait_until(lambda: "No space left" in queue.halt_reason, "the halt")
    count = len(begun)
    assert count <= 1
    with pytest.raises(StorageError):
        queue.go_on()
    assert len(begun) == count


def test_what_cannot_be_begun_is_told_and_the_watch_goes_on(
    queue: PlanQueue, running: Acquisitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(module, "subprocess", SimpleNamespace(Popen=none_left, DEVNULL=subprocess.DEVNULL))
    queue.add("Ada", plan="one.yaml")
    cells.wait_until(lambda: queue.entries[0].state == "failed", "the failure")
    assert "temporarily unavailable" in queue.halt_reason
    monkeypatch.setattr(module, "running", none_left)
    cells.wait_until(lambda: "BlockingIOError" in queue.halt_reason, "what went wrong in the watch")
    assert running._thread.is_alive()


@contextmanager
def live(rig: Path) -> Iterator[None]:
    """A live view of a cell."""
    process = cells.start("live", rig, "--yes")
    try:
        cells.wait_until(lambda: module.is_in_use(read_cell(rig)), "the live view")
        yield
    finally:
        process.terminate()
        cells.finish(process)


@pytest.mark.parametrize("had", [lambda rig: in_use(read_cell(rig)), pytest.param(live, marks=pytest.mark.full)])
def test_a_plan_waits_while_somebody_else_has_the_devices(
    queue: PlanQueue,
    begun: list[list[str]],
    running: Acquisitions,
    tmp_path: Path,
    had: Callable[[Path], AbstractContextManager[None]],
) -> None:
    with had(tmp_path / "rig.yaml"):
        queue.add("Ada", plan="one.yaml")
        time.sleep(1.0)
        assert begun == []
    cells.wait_until(lambda: begun, "the plan")


def test_a_queue_that_waits_for_something_else_by_now_does_not_go_on(tmp_path: Path) -> None:
    queue = PlanQueue(tmp_path / "queue.json")
    queue.halt("small.yaml: stopped")
    queue.halt("hold: change the object")
    with pytest.raises(InputError, match="change the object"):
        queue.go_on("small.yaml: stopped")
    assert queue.halt_reason
    queue.go_on("hold: change the object")
    assert not queue.halt_reason


def test_a_damaged_queue_is_refused(tmp_path: Path) -> None:
    (tmp_path / "queue.json").write_text('{"entries": [{"id": 1}]}')
    with pytest.raises(StorageError, match="the queue cannot be read"):
        PlanQueue(tmp_path / "queue.json")


def test_the_token_of_the_first_start_holds_until_an_engineer_has_an_account(tmp_path: Path) -> None:
    path = tmp_path / "accounts.json"
    first = Accounts(path)
    first.add("Ada", "a long password", Role.OPERATOR)
    again = Accounts(path)
    assert first.first_token
    assert again.first_token not in ("", first.first_token)
    again.remove("Ada")
    again.add("Ida", "a long password", Role.ENGINEER)
    assert again.first_token == Accounts(path).first_token == ""
    assert again.sign_in_first("") is None


def test_control_passes_to_another_when_its_holder_is_gone_for_five_minutes(tmp_path: Path) -> None:
    now_s = [0.0]
    accounts = Accounts(tmp_path / "accounts.json")
    ada, max_, ida = (
        accounts.add(name, "a long password", role)
        for name, role in (("Ada", Role.OPERATOR), ("Max", Role.OPERATOR), ("Ida", Role.ENGINEER))
    )
    control = Control(lambda: now_s[0])
    assert control.act(ada)
    now_s[0] = 299.0
    assert not control.act(max_)
    assert control.take(max_).name == "Ada"
    now_s[0] = 301.0
    assert control.take(max_).name == "Max"
    assert control.take(ida).name == "Ida", "an engineer's at any time"
    with pytest.raises(InputError, match="last engineer"):
        accounts.remove("Ida")
    assert [account.name for account in Accounts(tmp_path / "accounts.json").all_accounts()] == [
        "Ada",
        "Ida",
        "Max",
    ]


def test_a_run_that_falls_silent_is_still_at_work_and_a_stop_interrupts_its_process(
    queue: PlanQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Acquisitions(queue, read_cell(CellFolder(tmp_path).rig), tmp_path / "output")
    entry = queue.add("Ada", plan="one.yaml")
    with subprocess.Popen(["sleep", "12"]) as process:
        found._process = process
        queue.change(entry.id, state="running", pid=process.pid)
        run = tmp_path / "run"
        told = {"run": str(run), "rig": found._rig, "pid": process.pid, "state": "running", "proven": 52}
        silent = {"run": "", "rig": "", "pid": 0, "state": "silent", "socket": named_after(run, "sock").name}
        for states in ([told], [silent], [silent]):
            monkeypatch.setattr(module, "running", lambda states=states: states)
            found._look()
        assert found.state == {**told, "state": "silent"}
        found.state = None  # of a service that has just begun
        found._look()
        assert found.state is not None
        assert (found.state["state"], found.state["run"]) == ("silent", str(run))
        assert "does not answer" in found.tell("run", "stop")["trouble"][0]
        assert process.wait(10.0) == -signal.SIGINT


@pytest.mark.parametrize("by", ["its entry", "its run"])
def test_the_queue_halts_after_a_stop_that_came_when_the_run_was_complete(
    queue: PlanQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """The process ends with 0 then; the person believes that all stands."""
    found = Acquisitions(queue, read_cell(CellFolder(tmp_path).rig), tmp_path / "output")
    entry = queue.add("Ada", plan="one.yaml")
    with subprocess.Popen(["python3", "-c", COMPLETE], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        found._process = process
        queue.change(entry.id, state="running", pid=process.pid, run=str(tmp_path / "20261201-one"))
        (tmp_path / "output").mkdir()
        monkeypatch.setattr(found, "_is_alive", lambda _: process.poll() is None)
        if by == "its entry":
            found.stop(queue.entry(entry.id))
        else:
            assert found.tell("20261201-one", "stop")["state"] == "stopping"
        process.wait()
    found._look_after(queue.entry(entry.id))
    assert (queue.entry(entry.id).state, queue.entry(entry.id).exit_code) == ("done", 0)
    assert "stopped when it was complete" in queue.halt_reason


COMPLETE = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); print(1, flush=True); import time; time.sleep(1)"
)


def test_a_hundred_ended_entries_are_kept_and_what_others_printed_is_taken_away(
    queue: PlanQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_queue, "write_synced", lambda path, text: path.write_text(text))
    output = tmp_path / "output"
    output.mkdir()
    holds = [queue.add("Ada", hold="turn it").id for _ in range(105)]
    for number in holds[:103]:
        (output / f"{number}.log").write_text("said")
        queue.change(number, state="done", ended="2026-01-01T00:00:00.000Z")
    queue.halt("wait")
    assert [entry.id for entry in PlanQueue(tmp_path / "queue.json").entries] == holds[3:]
    with Acquisitions(queue, read_cell(CellFolder(tmp_path).rig), output):
        assert {path.stem for path in output.iterdir()} == set(holds[3:103])
    assert [entry.id for entry in _entries_now(queue, None)] == holds[83:]

"""`coupole stop` reaches a session before its run begins: while it checks the plan, or opens devices."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.acquisition import runtime_folder, starting_processes
from coupole.acquisition.sessions_without_run import SessionEnded, ask_session, sessions_without_run
from coupole.commands import run_controls, stopping

PATIENT_S = 5.0
"""Time that a stop waits for the answer of a session that may be the one that is meant."""
PREFLIGHT, OPENING = "views, shots, frames", "opening the devices"


def _until(process: subprocess.Popen[str], words: str) -> None:
    """Read what a session says until a line has these words."""
    assert process.stderr is not None
    assert any(words in line for line in iter(process.stderr.readline, "")), f"it never said {words!r}"


def _moves_and_lights(cell: CellFolder) -> list[str]:
    runs = (cell.folder / "storage").glob("2*")
    return [event["event"] for run in runs for event in cells.events(run) if event["event"] in ("move", "begin")]


@pytest.mark.parametrize("words", [PREFLIGHT, OPENING])
def test_a_session_that_is_starting_is_stopped_and_does_nothing(tmp_path: Path, words: str) -> None:
    cell = CellFolder(tmp_path)
    cell.join()
    with cell.world() as world:
        process = cells.start("acquire", cell.plan, "--yes")
        _until(process, words)
        stopped = cells.here("stop", cell.plan)
        assert stopped.code == 0, stopped.err
        assert f"stopped while it was starting: {cell.plan}" in " ".join((stopped.out + stopped.err).split())
        assert process.poll() is not None, "it has ended when the answer is given"
        assert cells.finish(process).code == 130
        state = world.ask("state")
        assert not state["shining"]
        assert not state["arm_moving"]
        assert _moves_and_lights(cell) == []
        assert str(cell.plan) not in [state["plan"] for _, state in sessions_without_run(PATIENT_S)]


def test_a_run_that_is_being_resumed_is_stopped_by_its_folder(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights={"kind": "every", "every": 2})  # it has long not ended when it is stopped
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 3, "proven frames")
    assert cells.here("stop", run).code == 0
    cells.finish(process)
    before = _moves_and_lights(cell)
    process = cells.start("acquire", "--resume", run, "--yes")
    _until(process, OPENING)
    stopped = cells.here("stop", run)
    assert stopped.code == 0, stopped.err
    assert cells.finish(process).code == 130
    assert _moves_and_lights(cell) == before
    assert cell.acquire("--resume", run).document["missing"] == 0


@pytest.mark.parametrize("file", ["plan", "rig"])
def test_a_run_that_has_begun_is_stopped_by_its_plan_or_rig_too(tmp_path: Path, file: str) -> None:
    cell = CellFolder(tmp_path)
    cell.write(views=[cells.TOP, cells.SIDE], lights={"kind": "every", "every": 5})
    process = cell.start_acquire()
    cells.wait_until(lambda: cells.frame_lines(cell.run_folder) > 3, "proven frames")
    paused = cells.here("pause", getattr(cell, file), "--json")
    assert paused.code == 0, paused.err
    assert paused.document["state"] == "paused"
    stopped = cells.here("stop", getattr(cell, file))
    assert stopped.code == 0, stopped.err
    assert cells.finish(process).code == 130


def test_a_metering_is_stopped_by_its_plan(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights={"kind": "all"}, exposure={"kind": "fixed", "exposure_us": 60_000})  # more than a minute
    process = cells.start("meter", cell.plan, "--yes")
    _until(process, "simulated")
    stopped = cells.here("stop", cell.plan)
    assert stopped.code == 0, stopped.err
    assert cells.finish(process).code == 130


def test_a_session_is_stopped_as_soon_as_its_process_was_started(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    process = cells.start("acquire", cell.plan, "--yes", anew=True)
    stopped = cells.here("stop", cell.plan)
    assert stopped.code == 0, stopped.err
    assert cells.finish(process).code == 130
    assert not list((tmp_path / "storage").glob("2*"))


def test_a_session_that_is_starting_is_stopped_by_the_rig_that_its_plan_names(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    process = cells.start("acquire", cell.plan, "--yes", anew=True)
    stopped = cells.here("stop", cell.rig)
    assert stopped.code == 0, stopped.err
    assert cells.finish(process).code == 130


def test_a_second_stop_of_a_run_waits_for_the_same_end(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write(views=[cells.TOP, cells.SIDE], lights={"kind": "every", "every": 5})
    process = cell.start_acquire()
    cells.wait_until(lambda: cells.frame_lines(cell.run_folder) > 3, "proven frames")
    first = cells.start("stop", cell.plan)
    cells.wait_until(lambda: cells.events(cell.run_folder, "stop"), "the end of the session")
    second = cells.start("stop", cell.plan)
    ended = cells.finish(second)
    has_ended_before = ended.code == 2 and process.poll() is not None  # on a busy machine
    assert has_ended_before or (ended.code == 0 and "lights are off" in ended.err), ended.err
    ended = cells.finish(first)
    assert ended.code == 0, ended.err
    assert "lights are off" in ended.err
    assert cells.finish(process).code == 130


# -- in a runtime folder of their own, without the sessions of other tests ---------------------------------------

_STARTING = """
import sys, time
from pathlib import Path
from coupole.acquisition import runtime_folder
from coupole.acquisition.sessions_without_run import SessionWithoutRun
runtime_folder._BASE = Path(sys.argv[1])
try:
    with SessionWithoutRun("acquire", Path(sys.argv[2]), None) as session:
        if run := sys.argv[4:]:
            session.begin_run(Path(run[0]))
        print("serves", flush=True)
        time.sleep(60)
except KeyboardInterrupt:
    print("ends", flush=True)
    time.sleep(float(sys.argv[3]))
"""
_STOP = """
import sys
from pathlib import Path
from coupole.acquisition import runtime_folder
runtime_folder._BASE = Path(sys.argv.pop(1))
from coupole.commands import cli
cli.main()
"""


@contextmanager
def _starts(plan: Path, *runs: Path, ends_in_s: float = 0.0) -> Iterator[subprocess.Popen[str]]:
    """A process that is starting, or has a run, for as long as nobody stops it; it then takes some time to end."""
    words = (runtime_folder._BASE, plan, ends_in_s, *runs)
    arguments = [sys.executable, "-c", _STARTING, *map(str, words)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "serves\n"
            yield process
        finally:
            process.kill()


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="apart-") as folder:  # short: the path of a socket has 107 bytes
        monkeypatch.setattr(runtime_folder, "_BASE", Path(folder))
        yield Path(folder)


def test_the_only_session_that_is_starting_needs_no_name(apart: Path) -> None:
    with _starts(apart / "plan.yaml") as process:
        stopped = cells.here("stop")
        assert stopped.code == 0, stopped.err
        assert process.poll() is not None
    nobody = cells.here("stop")
    assert nobody.code == 2
    assert "no run that answers" in nobody.err


def test_a_session_that_is_starting_has_nothing_to_pause(apart: Path) -> None:
    with _starts(apart / "plan.yaml") as process:
        paused = cells.here("pause")
        assert paused.code == 2
        assert "the run has not begun; `coupole stop` ends it" in " ".join((paused.out + paused.err).split())
        assert process.poll() is None


def test_a_session_that_is_slow_to_answer_is_not_overlooked(apart: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starting_processes, "YOUNG_S", 0.0)  # those of other tests are not waited for
    plan = apart / "plan.yaml"
    with _starts(plan) as process:
        process.send_signal(signal.SIGSTOP)
        timer = threading.Timer(10.0, process.send_signal, [signal.SIGCONT])  # later than all looks wait
        timer.start()
        stopped = cells.here("stop", plan)
        timer.join()
        assert stopped.code == 0, stopped.err
        assert f"process {process.pid} is stopped" in " ".join((stopped.out + stopped.err).split())
        assert process.poll() is not None


def test_a_session_that_ends_before_its_answer_was_sent_is_stopped(apart: Path) -> None:
    path = runtime_folder.runtime_folder() / "1.start"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()

        def closes() -> None:
            connection, _ = listening.accept()
            connection.recv(1000)
            connection.close()

        closing = threading.Thread(target=closes)
        closing.start()
        state = {"run": "", "plan": "plan.yaml", "rig": "", "doing": "acquire", "pid": 1}
        assert ask_session(path, state, "stop", print)["state"] == "stopping"
        closing.join()


def test_a_second_stop_of_a_session_that_ends_meanwhile_waits_for_the_same_end(
    apart: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first stop is obeyed between two steps of the second one: it has found the session, and asks it now."""
    monkeypatch.setattr(starting_processes, "YOUNG_S", 0.0)
    found = run_controls.sessions

    with _starts(apart / "plan.yaml") as process:

        def find_and_end(patience_s: float) -> object:
            sessions = found(patience_s)
            process.kill()
            process.wait()
            for socket_path in apart.rglob("*.start"):
                socket_path.unlink()
            return sessions

        monkeypatch.setattr(stopping, "sessions", find_and_end)
        stopped = cells.here("stop")
        assert stopped.code == 0, stopped.err
        assert "ended while it was asked to stop" in stopped.out + stopped.err
        assert f"process {process.pid} has ended" in " ".join((stopped.out + stopped.err).split())


def test_a_process_whose_run_has_its_last_frame_is_interrupted(apart: Path, tmp_path: Path) -> None:
    """The run's own socket has gone: the report is written, or a result is made, and then more might follow."""
    cell = CellFolder(tmp_path)
    run = Path(cells.here("acquire", cell.plan, "--yes", "--json").document["run"])
    with _starts(cell.plan, run) as process:
        stopped = cells.here("stop", cell.plan)
        assert stopped.code == 0, stopped.err
        assert "lights are off" in stopped.err
        assert process.stdout is not None
        assert process.stdout.read() == "ends\n"


def test_a_session_whose_socket_has_gone_is_not_said_to_give_no_answer(apart: Path) -> None:
    state = {"run": "", "plan": "", "rig": "rig.yaml", "doing": "meter bust", "pid": 1}
    with pytest.raises(SessionEnded, match=r"meter bust rig\.yaml: it has just ended"):
        ask_session(runtime_folder.runtime_folder() / "1.start", state, "stop", print)


def test_a_frozen_session_does_not_delay_the_stop_of_another_one(
    apart: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By no more than a first short look: the waits are twelve times those of the product."""
    waits_s = tuple(12.0 * wait_s for wait_s in stopping.SESSION_PATIENCE_S)
    monkeypatch.setattr(stopping, "SESSION_PATIENCE_S", waits_s)
    with _starts(apart / "frozen.yaml") as frozen, _starts(apart / "plan.yaml") as process:
        frozen.send_signal(signal.SIGSTOP)
        begun_s = time.monotonic()
        assert cells.here("stop", apart / "plan.yaml").code == 0
        assert process.poll() is not None
        assert time.monotonic() - begun_s < max(waits_s)
        assert frozen.poll() is None


def test_of_several_sessions_that_are_starting_one_must_be_named(apart: Path) -> None:
    plans = [apart / "one.yaml", apart / "other.yaml"]
    with ExitStack() as stack:
        processes = [stack.enter_context(_starts(plan)) for plan in plans]
        stopped = cells.here("stop")
        assert stopped.code == 2
        assert all(str(plan) in stopped.err for plan in plans)
        for plan, process in zip(plans, processes, strict=True):
            assert process.poll() is None
            assert cells.here("stop", plan).code == 0
            assert process.poll() is not None


def test_all_sessions_with_the_named_plan_are_stopped(apart: Path) -> None:
    plan = apart / "plan.yaml"
    with _starts(plan) as one, _starts(plan) as other, _starts(apart / "another.yaml") as third:
        stopped = cells.here("stop", plan, "--json")
        assert stopped.code == 0, stopped.err
        assert [process.poll() is None for process in (one, other, third)] == [False, False, True]
        assert {state["pid"] for state in json.loads(stopped.out)} == {one.pid, other.pid}


def test_a_second_stop_waits_for_the_end_that_the_first_one_has_begun(apart: Path) -> None:
    plan = apart / "plan.yaml"
    with _starts(plan, ends_in_s=2.0) as process:
        command = [sys.executable, "-c", _STOP, str(apart), "stop", str(plan)]
        with subprocess.Popen(command, cwd=cells.REPO, stderr=subprocess.PIPE) as first:
            assert process.stdout is not None
            assert process.stdout.readline() == "ends\n"
            second = cells.here("stop")
            assert second.code == 0, second.err
            assert "is being stopped already" in " ".join(second.err.split())
            assert process.poll() is not None
            assert first.wait(cells.PATIENCE_S) == 0


def test_what_is_just_starting_beside_the_only_session_is_named(apart: Path) -> None:
    """A process that cannot be asked yet is not what a stop without a name waits for."""
    with _starts(apart / "plan.yaml") as process:
        young = cells.start("acquire", apart / "other.yaml", anew=True)
        young.send_signal(signal.SIGSTOP)
        try:
            stopped = cells.here("stop")
            assert stopped.code == 0, stopped.err
            assert process.poll() is not None
            assert f"not stopped: `coupole acquire {apart}/other.yaml`" in "".join(stopped.err.split("\n"))
        finally:
            young.kill()
            cells.finish(young)


def test_a_stop_says_for_what_it_waits_that_is_just_starting(apart: Path) -> None:
    young = cells.start("meter", apart / "plan.yaml", anew=True)
    young.send_signal(signal.SIGSTOP)
    timer = threading.Timer(2.0, young.kill)
    timer.start()
    stopped = cells.here("stop", apart / "plan.yaml")
    timer.join()
    cells.finish(young)
    assert stopped.code == 2
    assert "is just starting: waiting" in " ".join(stopped.err.split())

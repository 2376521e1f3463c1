"""The socket of a running acquisition, by a client that knows nothing but its words."""

from __future__ import annotations

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cells
import pytest

from coupole.acquisition import run_control, runtime_folder, user_socket
from coupole.acquisition.observer import Control
from coupole.acquisition.run_control import RunControl, RunPaths, ask, running
from coupole.acquisition.safeguard import Safeguard
from coupole.acquisition.sessions_without_run import SessionWithoutRun, socket_of
from coupole.errors import InputError
from coupole.viewing.progress import Progress

PROGRESS = Progress("top", 0, 2, 52, 132, "led0417", 0.125, 33.5)


class Served:
    """A run's control, and what was done to it."""

    def __init__(self, folder: Path) -> None:
        self.run, self.control, self.halted = folder, Control(), 0
        self.lights_off: Callable[[], None] = lambda: None

    def halt(self) -> list[Safeguard]:
        assert self.control.stop.is_set(), "else the sequencer would light the next"
        self.halted += 1
        return [Safeguard("lights off", self.lights_off)]


@pytest.fixture(autouse=True)
def base(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Its path is short: a socket's may have 107 characters."""
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setattr(runtime_folder, "_BASE", Path(folder))
        yield Path(folder)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    found = Served(tmp_path / "run")
    paths = RunPaths(found.run, tmp_path / "plan.yaml", tmp_path / "rig.yaml")
    with RunControl(paths, found.control, found.halt, lambda: PROGRESS, {"relief": 4.5}) as control:
        assert control.trouble == ""
        yield found


def say(line: bytes) -> dict[str, object]:
    (path,) = runtime_folder.runtime_folder().glob("*.sock")
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(path))
        connection.sendall(line)
        return json.loads(connection.makefile().readline())  # type: ignore[no-any-return]


def test_it_pauses_goes_on_and_stops_and_tells_its_state_each_time(served: Served) -> None:
    assert say(b'{"version": 1, "command": "state"}\n') == {
        "version": 1, "run": str(served.run), "plan": str(served.run.parent / "plan.yaml"),
        "rig": str(served.run.parent / "rig.yaml"), "pid": os.getpid(),
        "state": "running", "view": "top",
        "view_number": 0, "views": 2, "proven": 52, "frames": 132, "light": "led0417", "dose_lux_h": 0.125,
        "left_s": 33.5, "light_after_lux_h": {"relief": 4.5},
    }  # fmt: skip
    assert say(b'{"version": 1, "command": "pause"}\n')["state"] == "pausing"
    assert served.control.pause.is_set()
    served.control.standing.set()
    assert ask(served.run, "pause")["state"] == "paused", "asked again it is no other"
    assert [state["state"] for state in running()] == ["paused"]
    served.control.standing.clear()
    assert ask(served.run, "go-on")["state"] == "running"
    assert not served.control.pause.is_set()
    assert served.halted == 0
    served.control.standing.set()
    assert ask(served.run, "go-on")["state"] == "running", "before the sequencer has seen it, too"
    served.control.standing.clear()
    stopped = ask(served.run, "stop")
    assert (stopped["state"], stopped["trouble"], served.halted) == ("stopping", [], 1)
    assert served.control.interruption().exit_code == 130


def test_a_word_before_the_session_stands_does_not_end_its_hold(served: Served) -> None:
    served.control.can_stand = True
    served.control.hold("the machine slept")
    assert ask(served.run, "go-on")["state"] == "pausing"
    served.control.hold_pending.clear()  # it stands, and has said why
    assert ask(served.run, "go-on")["state"] == "running"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"pause\n", "expected one line of JSON"),
        (b"[1]\n", "expected one line of JSON"),
        (b'{"command": "pause"}\n', "expected one line of JSON with `version`"),
        (b'{"version": 2, "command": "pause"}\n', "expected version 1"),
        (b'{"version": 1, "command": "Pause"}\n', "expected the command pause, go-on, stop or state"),
        (b'{"version": 1, "command": ["stop"]}\n', "expected the command"),
        (b"\xff" * 70_000, "expected one line of JSON"),
    ],
)
def test_what_is_no_request_changes_nothing_and_is_told_what_was_expected(
    served: Served, line: bytes, says: str
) -> None:
    assert says in str(say(line)["error"])
    assert not served.control.pause.is_set()
    assert not served.control.stop.is_set()
    assert ask(served.run, "state")["state"] == "running"


def test_a_word_to_go_on_is_not_heard_while_it_is_not_known_why_the_process_stood_still(served: Served) -> None:
    served.control.can_stand = True
    served.control.hold("the program did not run for 6.0 s")
    answer = ask(served.run, "go-on")
    assert "when the cell is safe, ask again" in answer["unheard"]
    assert served.control.pause.is_set()


def test_a_client_that_says_nothing_holds_up_no_other(served: Served) -> None:
    (path,) = runtime_folder.runtime_folder().glob("*.sock")
    with socket.socket(socket.AF_UNIX) as silent:
        silent.connect(str(path))
        assert ask(served.run, "stop")["state"] == "stopping"


def test_a_stop_of_which_it_is_not_sure_says_so(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_control, "_SAFE_WITHIN_S", 0.1)
    hangs = threading.Event()
    served.lights_off = lambda: hangs.wait(30.0) and None
    assert ask(served.run, "stop")["trouble"] == ["not sure: lights off: no answer within 15 s"]
    hangs.set()


def test_nobody_else_can_enter(served: Served) -> None:
    (path,) = runtime_folder.runtime_folder().glob("*.sock")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    runtime_folder.runtime_folder().chmod(0o755)
    with pytest.raises(InputError, match="nobody else may enter"):
        ask(served.run, "pause")


@pytest.mark.skipif(os.getuid() != 0, reason="only root can make another user's folder")
def test_a_folder_that_another_user_has_laid_out_is_passed_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All processes of a user find the same folder, though the other one goes away meanwhile."""
    monkeypatch.setattr(runtime_folder, "_BASE", tmp_path)
    taken = tmp_path / f"coupole-{os.getuid()}"
    taken.mkdir(mode=0o777)
    os.chown(taken, 65534, 65534)
    folder = runtime_folder.runtime_folder()
    assert folder == tmp_path / f"coupole-{os.getuid()}-1"
    assert folder.stat().st_mode & 0o777 == 0o700
    taken.rmdir()
    assert runtime_folder.runtime_folder() == folder
    folder.rmdir()
    for number in range(10):
        other = tmp_path / (f"coupole-{os.getuid()}" + (f"-{number}" if number else ""))
        other.touch()  # a file does as well
        os.chown(other, 65534, 65534)
    with pytest.raises(InputError, match="other users have taken this name and the next 9"):
        runtime_folder.runtime_folder()


def test_another_user_gets_no_answer(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user_socket, "peer_uid", lambda _: os.getuid() + 1)
    with pytest.raises(InputError, match="does not answer"):
        ask(served.run, "stop")
    assert served.halted == 0


def test_a_run_that_nobody_acquires_is_told_and_a_killed_one_is_told_from_one_that_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="no process of this user acquires into this run"):
        ask(tmp_path, "pause")
    with socket.socket(socket.AF_UNIX) as left_over:
        left_over.bind(str(runtime_folder.runtime_folder() / "0123.sock"))
    assert running() == []
    with socket.socket(socket.AF_UNIX) as hung:
        monkeypatch.setattr(user_socket.exchange, "__defaults__", (0.1,))
        hung.bind(str(runtime_folder.runtime_folder() / "4567.sock"))
        hung.listen()
        assert [state["state"] for state in running()] == ["silent"], "it may be at work"


def test_a_frozen_process_is_told_from_one_that_hangs(tmp_path: Path) -> None:
    path = tmp_path / "frozen.sock"
    serve = f"""
import time
from pathlib import Path
from coupole.acquisition.user_socket import UserSocket
with UserSocket(Path({str(path)!r}), lambda line, gone: time.sleep(60)):
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", serve]) as served:
        cells.wait_until(path.exists, "a socket")
        with pytest.raises(TimeoutError, match=f"nothing within 0.2 s from process {served.pid}"):
            user_socket.exchange(path, {}, 0.2)
        served.send_signal(signal.SIGSTOP)
        with pytest.raises(TimeoutError, match=f"process {served.pid} is stopped .*kill -CONT {served.pid}"):
            user_socket.exchange(path, {}, 0.2)
        served.kill()


def test_without_a_folder_for_its_socket_a_run_is_acquired_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime_folder, "_BASE", tmp_path / ("long" * 30))
    paths = RunPaths(tmp_path, tmp_path / "plan.yaml", tmp_path / "rig.yaml")
    with RunControl(paths, Control(), list, lambda: None) as control:
        assert "will not reach this run" in control.trouble


def test_a_run_stops_if_its_session_was_told_so_before_and_the_signal_ended_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other people's code may catch the exception of the signal."""
    monkeypatch.setattr(os, "kill", lambda *_: None)
    session, control = SessionWithoutRun("acquire", tmp_path / "plan.yaml"), Control()
    paths = RunPaths(tmp_path, tmp_path / "plan.yaml", tmp_path / "rig.yaml")
    with session:
        assert run_control.exchange_command(socket_of(os.getpid()), "stop")["state"] == "stopping"
        with RunControl(paths, control, list, lambda: None, when_served=session.begin_run):
            assert control.stop.is_set()
    assert control.interruption().exit_code == 130


def test_who_has_gone_before_the_word_is_heard_does_not_end_a_pause(tmp_path: Path) -> None:
    serve = f"""
import time
from pathlib import Path
from coupole.acquisition import runtime_folder
from coupole.acquisition.observer import Control
from coupole.acquisition.run_control import RunControl, RunPaths
runtime_folder._BASE = Path({str(runtime_folder._BASE)!r})
control = Control()
control.pause.set()
paths = RunPaths(Path({str(tmp_path)!r}), Path("plan.yaml"), Path("rig.yaml"))
with RunControl(paths, control, list, lambda: None):
    print("serves", flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", serve], stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        assert served.stdout.readline() == "serves\n"
        (path,) = runtime_folder.runtime_folder().glob("*.sock")
        served.send_signal(signal.SIGSTOP)
        with socket.socket(socket.AF_UNIX) as gone:
            gone.connect(str(path))
            gone.sendall(b'{"version": 1, "command": "go-on"}\n')
        served.send_signal(signal.SIGCONT)
        assert ask(tmp_path, "state")["state"] == "pausing"
        assert ask(tmp_path, "go-on")["state"] == "running", "one who waits is heard"
        served.kill()

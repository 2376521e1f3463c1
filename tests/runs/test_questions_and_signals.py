"""A question is asked while a cell's devices are held: a signal ends it as any other wait; and who may answer."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from at_a_terminal import Typist, at_a_terminal
from cells import CellFolder
from real_cells import real_cell

from coupole.acquisition.cell_marks import is_in_use
from coupole.plan.cell import read_cell
from coupole.preflight.commissioned import read_commissioning
from sim.world.client import World

ENDS_WITHIN_S = 10.0
"""With the closing of devices on a busy machine; without an end of the question it takes for ever."""


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    found = CellFolder(tmp_path_factory.mktemp("asked"), speed=1.0)
    found.join()
    return found


@pytest.fixture(scope="module")
def world(cell: CellFolder) -> Iterator[World]:
    with cell.world() as found:
        yield found


def end_by(typist: Typist, number: signal.Signals, rig: Path) -> None:
    begun_s = time.monotonic()
    typist.process.send_signal(number)
    assert typist.process.wait(ENDS_WITHIN_S) == 128 + number, typist.shown.decode()
    print(f"ended {time.monotonic() - begun_s:.2f} s after {number.name}")
    assert not is_in_use(read_cell(rig))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_question_before_a_drive(cell: CellFolder, world: World, number: signal.Signals) -> None:
    with at_a_terminal("arm", cell.rig, "home") as typist:
        typist.waits_for("Drive the arm along this path? [y/N]")
        assert is_in_use(read_cell(cell.rig))
        end_by(typist, number, cell.rig)
    assert cells.safe(world)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_first_question_of_a_commissioning(
    cell: CellFolder, world: World, number: signal.Signals
) -> None:
    with at_a_terminal("commission", cell.rig, "--name", "A", "--only", "axes") as typist:
        typist.waits_for("Go on? [y/N]")
        end_by(typist, number, cell.rig)
    assert cells.safe(world)


@pytest.mark.parametrize("answers", [0, 3], ids=["first question", "what was seen"])
def test_a_terminal_that_is_gone_answers_nothing_even_before_its_signal_comes(
    cell: CellFolder, world: World, answers: int
) -> None:
    """Here no signal comes at all: the terminal is not that of the command's session."""
    keyboard_fd, terminal_fd = pty.openpty()
    words = ("commission", cell.rig, "--name", "A", "--only", "axes")
    process = cells.start(*words, stdin=terminal_fd, stderr=subprocess.PIPE)
    os.close(terminal_fd)
    shown = ""
    for number in range(answers + 1):
        shown = _read_until("[y/N]", process)
        if number < answers:
            os.write(keyboard_fd, b"y\n")
    assert ("Did you see exactly this?" in shown) is (answers == 3)
    os.close(keyboard_fd)
    ended = cells.finish(process)
    assert ended.code == 129, ended
    assert read_commissioning(read_cell(cell.rig)) is None, "nothing was answered"
    assert cells.safe(world)


def _read_until(words: str, process: subprocess.Popen[str]) -> str:
    """Read from a command's messages up to these words; return what was read."""
    assert process.stderr is not None
    shown = ""
    while not shown.endswith(words):
        letter = process.stderr.read(1)
        assert letter, shown
        shown += letter
    return shown


def test_the_end_of_the_input_of_a_terminal_that_is_there_is_a_no(cell: CellFolder, world: World) -> None:
    with at_a_terminal("commission", cell.rig, "--name", "A", "--only", "axes") as typist:
        typist.waits_for("Go on? [y/N]")
        typist.types("\x04")  # Ctrl-D
        assert typist.process.wait(cells.PATIENCE_S) == 130
    assert cells.safe(world)


def test_a_signal_is_no_answer_to_what_a_person_saw(cell: CellFolder, world: World) -> None:
    """The questions of a step are asked in a thread of their own. An unanswered one is no result of the step."""
    with at_a_terminal("commission", cell.rig, "--name", "A", "--only", "axes") as typist:
        for times in (1, 2, 3):
            typist.waits_for("Go on? [y/N]", times)
            typist.types("y\n")
        typist.waits_for("Did you see exactly this? [y/N]")
        end_by(typist, signal.SIGTERM, cell.rig)
    assert read_commissioning(read_cell(cell.rig)) is None, "nothing was answered"
    assert cells.safe(world)


def test_a_real_cell_is_commissioned_by_a_person_at_a_terminal(tmp_path: Path) -> None:
    """`yes | coupole commission` moved the arm and had its step passed, though `--yes` is refused there."""
    with real_cell(tmp_path) as (cell, world):
        before_deg = world.ask("state")["joints_deg"]
        words = ("commission", cell.rig, "--name", "A", "--only", "cycle")
        process = cells.start(*words, stdin=subprocess.PIPE)
        assert process.stdin is not None
        process.stdin.write(100 * "y\n")
        ended = cells.finish(process)
        assert ended.code == 2, ended
        assert "where a person must see and answer: type the command at a terminal" in " ".join(ended.err.split())
        assert "(simulated)" not in ended.err
        assert "robot:" not in ended.err, "no device was opened"
        assert world.ask("state")["joints_deg"] == before_deg
        with at_a_terminal(*words) as typist:
            typist.waits_for("Go on? [y/N]")
            typist.types("n\n")
            assert typist.process.wait(cells.PATIENCE_S) == 130, typist.shown.decode()


_READS_THE_RECORD = """
import os, sys
from pathlib import Path
from coupole.errors import StorageError
from coupole.plan.cell import read_cell
from coupole.preflight.commissioned import read_commissioning
cell = read_cell(Path(sys.argv[1]))
if os.geteuid() == 0:
    os.seteuid(65534)
try:
    read_commissioning(cell)
except StorageError as error:
    print(error.exit_code, error)
"""


def test_a_record_in_a_folder_that_another_user_has_is_no_defect(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    state = tmp_path / "storage/state"
    state.mkdir(parents=True)
    state.chmod(0)
    command = [sys.executable, "-c", _READS_THE_RECORD, str(cell.rig)]
    ended = subprocess.run(command, cwd=cells.REPO, capture_output=True, text=True, check=True)
    assert ended.stdout.startswith("6 ")
    assert "cannot read the record of the commissioning: Permission denied" in ended.stdout


def test_a_console_whose_folder_cannot_be_made_is_no_defect(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    (tmp_path / "file").write_text("")
    cell.rig_data["storage"]["state"] = str(tmp_path / "file" / "state")
    cell.write()
    ended = cells.here("serve", cell.rig)
    assert (ended.code, "the console's folder cannot be used: Not a directory" in ended.err) == (6, True), ended


def test_a_simulated_cell_may_be_answered_from_a_pipe(cell: CellFolder, world: World) -> None:
    process = cells.start("commission", cell.rig, "--name", "A", "--only", "cycle", stdin=subprocess.PIPE)
    assert process.stdin is not None
    process.stdin.write("y\nn\n")
    ended = cells.finish(process)
    assert ended.code == 130, ended
    assert "Step cycle" in ended.err

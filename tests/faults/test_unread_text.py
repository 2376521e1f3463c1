"""Terminals and pipes that nobody reads: a run waits for none of them, ends as fast as ever, and says so."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path

import cells
import pytest
from cells import CellFolder
from in_part import in_part
from places import REPO

from sim.world.client import World

SPEAK_MUCH = """
import os, sys, threading
from coupole.viewing import text_outlet
text_outlet.install()
for number in range(40000):
    print(f"line {number} " + 80 * "x", file=sys.stderr)
os.write(2, b"of a library\\n")
os.system("echo of a child >&2")
print("the document")
print("last", file=sys.stderr)
text_outlet.finish()
"""


PRINT_A_DOCUMENT = """
from coupole.viewing import text_outlet
text_outlet.install()
print("the document")
text_outlet.finish()
"""

CLOSE_ALL = """
import os, threading
from coupole.viewing import text_outlet
text_outlet.install()
os.close(1)
os.close(2)
for thread in threading.enumerate():
    if thread.name.startswith("text into"):
        thread.join(20)
        assert not thread.is_alive()
"""


@pytest.fixture
def standing(tmp_path: Path) -> Iterator[tuple[CellFolder, World]]:
    """A cell whose world outlives its controllers."""
    cell = CellFolder(tmp_path)
    cell.join()
    with cell.world() as world:
        yield cell, world


def fill(writer: int) -> int:
    """Fill a pipe; how many bytes it took."""
    os.set_blocking(writer, False)
    count = 0
    with suppress(BlockingIOError):
        while True:
            count += os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    return count


@contextmanager
def full_pipe() -> Iterator[int]:
    """The end for writing of a pipe that is full and is never read."""
    reader, writer = os.pipe()
    fill(writer)
    yield writer
    os.close(reader)
    os.close(writer)


@contextmanager
def stopped_terminal(columns: int = 80) -> Iterator[int]:
    """A terminal whose output was stopped by Ctrl-S."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("4H", 24, columns, 0, 0))
    os.write(master, b"\x13")
    yield slave
    os.close(master)
    os.close(slave)


@contextmanager
def closed_pipe() -> Iterator[int]:
    """A pipe whose reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


READERS = {"full pipe": full_pipe, "stopped terminal": stopped_terminal, "closed pipe": closed_pipe}


@pytest.mark.parametrize("kind", READERS)
def test_a_run_whose_text_nobody_reads_is_done_and_its_journal_says_so(kind: str, tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    with READERS[kind]() as nobody:
        process = cells.start("acquire", cell.plan, "--yes", stdout=nobody, stderr=nobody)
        assert cells.finish(process).code == 0
    cells.assert_each_shot_proven_once(cell.run_folder)
    (unread,) = cells.events(cell.run_folder, "unread")
    assert unread["lost_bytes"] + unread["waiting_bytes"] > 0


@pytest.mark.parametrize("kind", in_part(READERS, "full pipe"))
def test_json_that_nobody_reads_changes_no_exit_code(kind: str, tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    with READERS[kind]() as nobody:
        assert cells.finish(cell.start_acquire(stdout=nobody)).code == 0
    cells.assert_each_shot_proven_once(cell.run_folder)


@pytest.mark.parametrize(
    ("ending", "kind"),
    in_part(
        product((signal.SIGTERM, signal.SIGINT, signal.SIGHUP, None), READERS),
        (signal.SIGTERM, "stopped terminal"),
        (signal.SIGINT, "closed pipe"),
        (signal.SIGHUP, "full pipe"),
        (None, "full pipe"),
    ),
)
def test_a_run_whose_text_nobody_reads_is_ended_by_signals_and_by_stop(
    kind: str, ending: signal.Signals | None, standing: tuple[CellFolder, World]
) -> None:
    cell, world = standing
    cell.write(repeats=8)
    with READERS[kind]() as nobody:
        process = cells.start("acquire", cell.plan, "--yes", stdout=nobody, stderr=nobody)
        run = cell.run_folder
        cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
        if ending is None:
            assert cells.here("stop", run).code == 0
        else:
            process.send_signal(ending)
        assert cells.finish(process).code == 128 + (ending or signal.SIGINT)
    assert cells.safe(world)
    assert cells.events(run)[-1]["event"] == "stop"


def test_a_run_on_a_terminal_of_twenty_columns_that_nobody_reads_is_done(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    with stopped_terminal(20) as nobody:
        process = cells.start("acquire", cell.plan, "--yes", stdout=nobody, stderr=nobody)
        assert cells.finish(process).code == 0
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_a_run_without_any_standard_stream_is_done(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    words = [sys.executable, "-m", "coupole", "acquire", str(cell.plan), "--yes"]
    ended = subprocess.run(
        ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *words], cwd=REPO, timeout=cells.PATIENCE_S, check=False
    )
    assert ended.returncode == 0
    cells.assert_each_shot_proven_once(cell.run_folder)


def test_a_reader_who_comes_back_gets_the_newest_text_and_the_number_of_dropped_lines() -> None:
    reader, writer = os.pipe()
    with subprocess.Popen(
        [sys.executable, "-c", SPEAK_MUCH.replace("finish()", "finish(9)")],
        stdout=subprocess.PIPE,
        stderr=writer,
        cwd=REPO,
        text=True,
    ) as process:
        os.close(writer)
        assert process.stdout is not None
        assert process.stdout.readline() == "the document\n"  # though nobody has read the rest
        with os.fdopen(reader, encoding="utf-8") as text:
            said = text.read()
    assert process.returncode == 0
    assert said.startswith("line 0 ")
    assert "lines of text (" in said
    assert said.rstrip().endswith("of a library\nof a child\nlast")


def test_a_reader_who_reads_gets_every_line() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", SPEAK_MUCH.replace("40000", "2000")],
        capture_output=True,
        cwd=REPO,
        text=True,
        check=True,
    )
    assert ended.stdout == "the document\n"
    words = [line.split(" x")[0] for line in ended.stderr.splitlines()]
    assert words == [*(f"line {number}" for number in range(2000)), "of a library", "of a child", "last"]


def test_a_command_that_nobody_reads_ends_within_a_bounded_time() -> None:
    speak = SPEAK_MUCH.replace("finish()", "finish(0.2, 0.2)")
    with full_pipe() as nobody:
        process = subprocess.Popen([sys.executable, "-c", speak], stdout=nobody, stderr=nobody, cwd=REPO)
        begun_s = time.monotonic()
        assert process.wait(cells.PATIENCE_S) == 0
    assert time.monotonic() - begun_s < cells.PATIENCE_S


def test_a_reader_of_the_document_who_pauses_for_three_seconds_gets_it() -> None:
    reader, writer = os.pipe()
    full = fill(writer)
    with subprocess.Popen([sys.executable, "-c", PRINT_A_DOCUMENT], stdout=writer, cwd=REPO) as process:
        os.close(writer)
        with suppress(subprocess.TimeoutExpired):
            process.wait(3.0)
        with os.fdopen(reader, "rb") as found:
            assert found.read()[full:] == b"the document\n"
    assert process.returncode == 0


def test_a_last_word_waits_for_no_reader_where_no_queue_lies_between() -> None:
    words = [sys.executable, "-c", "from coupole.viewing.text_outlet import say_now; say_now('a word', 0.1)"]
    for kind in READERS.values():
        with kind() as nobody:
            assert subprocess.run(words, stderr=nobody, cwd=REPO, timeout=30, check=False).returncode == 0
    assert subprocess.run(words, capture_output=True, cwd=REPO, check=True).stderr == b"a word"


@pytest.mark.parametrize("kind", ["full pipe", "stopped terminal"])
def test_a_command_without_a_cell_that_nobody_reads_is_ended_by_ctrl_c(kind: str) -> None:
    command = [sys.executable, "-m", "coupole", "schema", "plan"]
    with (
        READERS[kind]() as nobody,
        subprocess.Popen(command, stdout=nobody, stderr=nobody, cwd=REPO) as process,
    ):
        cells.wait_until(lambda: writes(process.pid), "a write that waits for its reader")
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(cells.PATIENCE_S) == 130
        finally:
            process.kill()


def writes(pid: int) -> bool:
    """Tell whether the main thread of a process is in `write` to a standard stream."""
    number, *arguments = Path(f"/proc/{pid}/syscall").read_text().split()
    return number in {"1", "64"} and arguments[0] in {"0x1", "0x2"}


def test_nobody_listens_to_descriptors_that_were_closed() -> None:
    assert subprocess.run([sys.executable, "-c", CLOSE_ALL], cwd=REPO, timeout=60, check=False).returncode == 0

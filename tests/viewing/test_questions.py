"""What the operator is asked at the terminal, and what counts as an answer."""

from __future__ import annotations

import io
import os
import pty
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import cells
import pytest

from coupole.errors import Interrupted
from coupole.viewing.questions import ask, ask_number, is_asked_at_a_terminal


class _Reader(io.StringIO):
    """Standard error with a person before it, who types when a question is there."""

    def __init__(self, keyboard_fd: int, answer: bytes) -> None:
        super().__init__()
        self._keyboard_fd, self._answer = keyboard_fd, answer

    def flush(self) -> None:
        os.write(self._keyboard_fd, self._answer)


def test_what_was_typed_before_a_question_does_not_answer_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """`coupole arm` drove along a path by a `y` that was typed before the path was shown."""
    keyboard_fd, terminal_fd = pty.openpty()
    with os.fdopen(terminal_fd, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        os.write(keyboard_fd, b"y\ny\n")
        monkeypatch.setattr(sys, "stderr", _Reader(keyboard_fd, b"n\n"))
        assert not ask("Drive?")
        os.write(keyboard_fd, b"12\n")
        monkeypatch.setattr(sys, "stderr", _Reader(keyboard_fd, b"34\n"))
        assert ask_number("Height:") == 34
    os.close(keyboard_fd)


def test_answers_of_a_pipe_count_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n12\n"))
    assert ask("Drive?")
    assert ask_number("Height:") == 12


@contextmanager
def piped(monkeypatch: pytest.MonkeyPatch) -> Iterator[IO[bytes]]:
    """Standard input as a pipe; gives its other end."""
    read_fd, write_fd = os.pipe()
    with os.fdopen(read_fd, encoding="utf-8") as stdin, os.fdopen(write_fd, "wb", buffering=0) as other_end:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield other_end


def test_each_question_takes_its_own_line_of_a_pipe_whose_end_is_no(monkeypatch: pytest.MonkeyPatch) -> None:
    with piped(monkeypatch) as other_end:
        other_end.write(b"y\n12,5 mm\nno\n\n\nyes")
        other_end.close()
        assert ask("Drive?")
        assert ask_number("Height:") == 12.5
        assert not ask("Drive?", default=True)
        assert ask("Ready?", default=True)
        assert not ask("Drive?")
        assert ask("Drive?"), "a last line without an end"
        assert not ask("Ready?", default=True)
        assert ask_number("Height:") is None
        assert not is_asked_at_a_terminal()


def test_an_answer_that_comes_in_pieces_counts_when_it_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    with piped(monkeypatch) as other_end:

        def type_slowly() -> None:
            for piece in (b"1", b"2.", b"5\nrest"):
                time.sleep(0.1)
                other_end.write(piece)

        typing = threading.Thread(target=type_slowly)
        typing.start()
        assert ask_number("Height:") == 12.5
        typing.join()


class OverAtItsSixthLook:
    """A session that is to end: it is over when the question has looked six times."""

    def __init__(self) -> None:
        self.looks = 0

    def __call__(self) -> bool:
        self.looks += 1
        return self.looks >= 6


@pytest.mark.parametrize("written", [b"", b"y", b"12"])
def test_a_question_is_given_up_when_the_session_is_to_end(
    monkeypatch: pytest.MonkeyPatch, written: bytes
) -> None:
    """Also in the midst of an answer: it looks again and again, and not once more when it is over."""
    with piped(monkeypatch) as other_end:
        in_vain = threading.Timer(cells.PATIENCE_S, other_end.close)
        in_vain.start()
        for question in (ask, ask_number):
            other_end.write(written)
            is_over = OverAtItsSixthLook()
            assert not question("Drive?", is_over)
            assert is_over.looks == 6
        in_vain.cancel()


def test_an_endless_answer_ends_with_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    over = threading.Event()
    with Path("/dev/zero").open(encoding="utf-8") as zeros:
        monkeypatch.setattr(sys, "stdin", zeros)
        threading.Timer(0.2, over.set).start()
        assert not ask("Drive?", over.is_set)


def test_no_standard_input_is_no(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("n\ny\n")
    with Path("/dev/null").open() as null, (tmp_path / "file").open() as file:
        closed = io.StringIO("y")
        closed.close()
        for stdin in (None, closed, null):
            monkeypatch.setattr(sys, "stdin", stdin)
            assert not ask("Drive?")
            assert ask_number("Height:") is None
            assert not is_asked_at_a_terminal()
        monkeypatch.setattr(sys, "stdin", file)
        assert (ask("Drive?"), ask("Drive?")) == (False, True)


def test_a_terminal_that_is_gone_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    keyboard_fd, terminal_fd = pty.openpty()
    with os.fdopen(terminal_fd, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        assert is_asked_at_a_terminal()
        os.close(keyboard_fd)
        with pytest.raises(Interrupted) as gone:
            ask("Drive?")
    assert gone.value.exit_code == 128 + signal.SIGHUP

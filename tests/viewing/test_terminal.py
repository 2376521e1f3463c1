"""What the operator reads and answers at the terminal."""

from __future__ import annotations

import io
import os
import pty
import sys

import pytest
from rich.table import Table

from coupole.viewing.terminal import ask, ask_number, make_console


@pytest.mark.parametrize(
    "folder", ["/data [old]/run", "/x[/y]z", "/[bold]x", "/a :bell: b", "/back\\[red]slash\\"]
)
def test_brackets_of_a_path_are_printed_as_they_are(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    """They would otherwise be rich's markup: left out, or an error that ends the session."""
    console, table = make_console(quiet=False), Table(box=None, show_header=False)
    table.add_row("device", folder)
    console.print(f"  frames  {folder}")
    console.print("[red]bad:[/]", folder)
    console.print(f"[yellow]{folder}[/]: report.html")
    console.print(table)
    lines = [line.strip() for line in capsys.readouterr().err.splitlines()]
    assert lines == [f"frames  {folder}", f"bad: {folder}", f"{folder}: report.html", f"device  {folder}"]


def test_colours_of_messages_remain() -> None:
    text = make_console(quiet=False).render_str("  [yellow]note:[/] a [red]b[/]", style="bold")
    assert text.plain == "  note: a b"
    assert [(span.start, span.end, span.style) for span in text.spans] == [(2, 7, "yellow"), (10, 11, "red")]


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

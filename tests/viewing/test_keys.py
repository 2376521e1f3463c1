"""Keys of the run's terminal."""

from __future__ import annotations

import os
import pty
import sys
import termios
from collections.abc import Iterator

import cells
import pytest

from coupole.viewing import keys


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    outer, inner = pty.openpty()
    with os.fdopen(inner, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
        yield outer, inner
    os.close(outer)


def test_a_key_alone_is_obeyed_and_function_keys_and_pasted_text_are_not(
    terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    outer, inner = terminal
    modes = termios.tcgetattr(inner)
    pressed: list[str] = []
    taken: list[bytes] = []
    read_from = os.read

    def read_and_tell(source: int, most: int) -> bytes:
        typing = read_from(source, most)
        taken.extend([typing] if source == inner else [])
        return typing

    monkeypatch.setattr(os, "read", read_and_tell)
    with keys.key_actions({"p": lambda: pressed.append("p"), "q": lambda: pressed.append("q")}) as read:
        assert read
        assert termios.tcgetattr(inner) != modes
        for typed in (b"\x1bOP", b"\x1bOQ", b"quick\n", b"x", b"pq"):
            os.write(outer, typed)
            cells.wait_until(lambda typed=typed: typed in taken, "its being read, before the next is typed")
        assert pressed == []
        for count, typed in enumerate((b"p", b"P", b"q\n"), start=1):
            os.write(outer, typed)
            cells.wait_until(lambda count=count: len(pressed) == count, "the key")
    assert pressed == ["p", "p", "q"]
    assert termios.tcgetattr(inner) == modes


def test_in_the_background_nothing_is_read_and_the_modes_are_left(
    terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    modes = termios.tcgetattr(terminal[1])
    with keys.key_actions({"p": lambda: None}) as read:
        assert not read
        assert termios.tcgetattr(terminal[1]) == modes

"""Questions to the person at the terminal. They are given up when the session that asks is to end."""

from __future__ import annotations

import contextlib
import math
import os
import select
import sys
import termios
from collections.abc import Callable

_LOOK_EVERY_MS = 50


def _forget_typing() -> None:
    """Drop the text that was typed at the terminal before a question, because it is not an answer to the
    question.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError, termios.error):  # no terminal
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def ask(question: str, is_over: Callable[[], bool] = lambda: False, *, default: bool = False) -> bool:
    """Ask a yes-or-no question on standard error, even with `--json`; any answer but yes counts as no, an empty
    one as `default`. What was typed before the question does not count. No answer is no: neither an input that has
    ended, nor a question that is given up because `is_over()`."""
    _forget_typing()
    print(f"{question} {'[Y/n]' if default else '[y/N]'} ", end="", file=sys.stderr, flush=True)
    line = _line_typed(is_over)
    return line.strip().lower() in ({"y", "yes", ""} if default and line else {"y", "yes"})


def ask_number(question: str, is_over: Callable[[], bool] = lambda: False) -> float | None:
    """Ask for a number on standard error, and ask again if the answer is not a number. Return None for an empty
    answer, or if the question is given up because `is_over()` is true.
    """
    while True:
        _forget_typing()
        print(f"{question} ", end="", file=sys.stderr, flush=True)
        if not (answer := _line_typed(is_over).strip()):
            return None
        with contextlib.suppress(ValueError):
            if math.isfinite(number := float(answer.removesuffix("mm").replace(",", "."))):
                return number
        print(f"expected a number, found {answer!r}", file=sys.stderr)


def is_asked_at_a_terminal() -> bool:
    """Tell whether standard input, from which answers come, is a terminal."""
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


def _line_typed(is_over: Callable[[], bool]) -> str:
    """Return the next line of standard input with its end; empty if there is none, or as soon as `is_over()`.

    A signal does not end a read in Python, so this waits in short steps. It takes byte after byte, so that the
    lines that follow are left to whoever asks next.
    """
    try:
        input_fd = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):  # no file: closed, or lines in memory
        return _line_in_memory()
    line, waiting = bytearray(), select.poll()
    waiting.register(input_fd, select.POLLIN)
    while not is_over():
        if not waiting.poll(_LOOK_EVERY_MS):
            continue
        try:
            byte = os.read(input_fd, 1)
        except BlockingIOError:
            continue
        except OSError:  # no standard input
            return ""
        line += byte
        if byte in (b"", b"\n"):
            return line.decode(errors="replace")
    return ""


def _line_in_memory() -> str:
    try:
        return sys.stdin.readline()
    except (OSError, ValueError, AttributeError):  # no standard input
        return ""

"""Questions to the person at the terminal. A question is withdrawn when the session that asks it has to end."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import stat
import sys
import termios
from collections.abc import Callable

from coupole.errors import Interrupted

_LOOK_EVERY_MS = 50


def _forget_typing() -> None:
    """Drop the text that was typed at the terminal before a question, because it is not an answer to the
    question.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError, termios.error):  # no terminal
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def ask(question: str, is_over: Callable[[], bool] = lambda: False, *, default: bool = False) -> bool:
    """Ask a yes-or-no question on standard error, even with `--json`; any answer but yes counts as no, an empty
    one as `default`. What was typed before the question does not count. A missing answer counts as no: the input
    has ended, or the question is withdrawn because `is_over()` is true. Raises Interrupted if the terminal is
    gone."""
    _forget_typing()
    print(f"{question} {'[Y/n]' if default else '[y/N]'} ", end="", file=sys.stderr, flush=True)
    line = _line_typed(is_over)
    return line.strip().lower() in ({"y", "yes", ""} if default and line else {"y", "yes"})


def ask_number(question: str, is_over: Callable[[], bool] = lambda: False) -> float | None:
    """Ask for a number on standard error, and ask again if the answer is not a number. Return None for an empty
    answer, or if the question is withdrawn because `is_over()` is true. Raises Interrupted if the terminal is
    gone.
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

    Raises Interrupted (exit code 129) if the terminal is gone: this is not an answer, and a read may show it
    before SIGHUP comes. A signal does not end a read in Python, so this waits in short steps. It takes byte after
    byte, so that the lines that follow are left for the next question.
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
            byte = b""
        if not byte and _is_hung_up(input_fd):
            raise Interrupted("the terminal is gone, so nobody can answer", signal.SIGHUP)
        line += byte
        if byte in (b"", b"\n"):
            return line.decode(errors="replace")
    return ""


def _is_hung_up(input_fd: int) -> bool:
    """Tell whether a file is a terminal that was closed at its other end. For a process that ignores SIGHUP
    (`nohup`), the answer is False."""
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return False
    try:
        is_terminal = stat.S_ISCHR(os.fstat(input_fd).st_mode)
    except OSError:
        return False
    looking = select.poll()
    looking.register(input_fd, 0)
    return is_terminal and any(events & select.POLLHUP for _, events in looking.poll(0))


def _line_in_memory() -> str:
    try:
        return sys.stdin.readline()
    except (OSError, ValueError, AttributeError):  # no standard input
        return ""

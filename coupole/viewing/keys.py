"""Single keys pressed in the terminal while something runs."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def obeyed(actions: Mapping[str, Callable[[], object]]) -> Iterator[bool]:
    """Call what belongs to a key when it is pressed, in another thread; True if keys are read.

    They are where standard input is a terminal and this process in its foreground. Ctrl-C and its like stay
    signals; the terminal's modes are as before when this ends.
    """
    if not _is_ours():
        yield False
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    ended, end = os.pipe()

    def read() -> None:
        while True:
            ready, _, _ = select.select([terminal, ended], [], [])
            if ended in ready:
                return
            pressed = os.read(terminal, 1).decode(errors="replace").lower()
            if not pressed:
                return
            if pressed in actions:
                actions[pressed]()

    thread = threading.Thread(target=read, name="keys", daemon=True)
    tty.setcbreak(terminal, termios.TCSANOW)
    thread.start()
    try:
        yield True
    finally:
        os.close(end)
        thread.join()
        os.close(ended)
        termios.tcsetattr(terminal, termios.TCSANOW, before)


def _is_ours() -> bool:
    try:
        terminal = sys.stdin.fileno()
        return os.isatty(terminal) and os.tcgetpgrp(terminal) == os.getpgrp()
    except (
        OSError,
        ValueError,
        AttributeError,
    ):  # no standard input, or not its own terminal
        return False

"""Single keys pressed in the terminal while something runs."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

_MOST_BYTES, _NAP_S = 64, 0.5


@contextmanager
def key_actions(actions: Mapping[str, Callable[[], object]]) -> Iterator[bool]:
    """Call the action of a key when the key is pressed alone (or with Enter), in another thread. Gives True if
    keys are read.

    Keys are read if standard input is a terminal and this process is in its foreground. In the background nothing
    is read, and the process is not stopped because of it. Several characters at once, from function keys or pasted
    text, do nothing. Ctrl-C and similar keys stay signals. The terminal's former modes are restored at the end.
    """
    if not _is_ours() or threading.current_thread() is not threading.main_thread():
        yield False
        return
    terminal = sys.stdin.fileno()
    modes = termios.tcgetattr(terminal)
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGTTIN, signal.SIGTTOU)}
    end_reader, end = os.pipe()
    thread = threading.Thread(target=_read_keys, args=(terminal, end_reader, actions), name="keys", daemon=True)
    try:
        tty.setcbreak(terminal, termios.TCSANOW)
        thread.start()
        yield True
    finally:
        os.close(end)
        if thread.ident is not None:
            thread.join()
        os.close(end_reader)
        if _is_ours():
            with contextlib.suppress(termios.error):  # the terminal may be gone
                termios.tcsetattr(terminal, termios.TCSANOW, modes)
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _read_keys(terminal: int, end_fd: int, actions: Mapping[str, Callable[[], object]]) -> None:
    while True:
        ready, _, _ = select.select([terminal, end_fd], [], [])
        if end_fd in ready:
            return
        try:
            typing = os.read(terminal, _MOST_BYTES)
        except OSError:  # in the background, or the terminal is gone
            if select.select([end_fd], [], [], _NAP_S)[0]:
                return
            continue
        if not typing:
            return
        key = typing.rstrip(b"\r\n").decode(errors="replace").lower()
        if key in actions:
            actions[key]()


def _is_ours() -> bool:
    """Tell whether standard input is a terminal that has this process in its foreground."""
    try:
        terminal = sys.stdin.fileno()
        return os.isatty(terminal) and os.tcgetpgrp(terminal) == os.getpgrp()
    except (OSError, ValueError, AttributeError):
        return False

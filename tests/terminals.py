"""Commands on a terminal of their own, forked where all modules are (tests/nursery.py)."""

from __future__ import annotations

import fcntl
import os
import sys
import termios

from coupole.commands import cli


def on_terminal(*arguments: str) -> None:
    """`coupole` with these arguments; standard input is the terminal that its session gets."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    os.environ |= {"TERM": "xterm-256color", "COLUMNS": "140", "LINES": "40"}
    sys.argv = ["coupole", *arguments]
    cli.main()

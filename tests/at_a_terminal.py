"""A command on a terminal of its own, with a person who reads and types there."""

from __future__ import annotations

import os
import pty
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import cells
from nursery import NURSERY

_ENDS_WITHIN_S = 20.0


@dataclass
class Typist:
    """The person: the process, this end of its terminal, the other end, and what it has shown."""

    process: subprocess.Popen[str]
    keyboard_fd: int
    terminal_fd: int
    shown: bytearray = field(default_factory=bytearray)

    def types(self, text: str) -> None:
        os.write(self.keyboard_fd, text.encode())

    def waits_for(self, words: str, times: int = 1) -> None:
        def is_there() -> bool:
            if self.shown.count(words.encode()) >= times:
                return True
            if self.process.poll() is None:
                return False
            time.sleep(1.0)  # its last words may still be on their way
            return True

        cells.wait_until(is_there, words)
        assert self.shown.count(words.encode()) >= times, self.shown.decode()


@contextmanager
def at_a_terminal(*arguments: str | Path) -> Iterator[Typist]:
    """Begin `coupole` with these arguments. It is ended at the end, if need be by force."""
    keyboard_fd, terminal_fd = pty.openpty()
    process = NURSERY.function(
        "terminals:on_terminal", [*map(str, arguments)],
        stdin=terminal_fd, stdout=subprocess.PIPE, stderr=terminal_fd, text=True,
    )  # fmt: skip
    typist = Typist(process, keyboard_fd, terminal_fd)

    def watch() -> None:
        while True:
            try:
                typist.shown.extend(os.read(keyboard_fd, 65536))
            except OSError:  # the last process has closed the other end
                return

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield typist
    finally:
        process.terminate()  # nothing, where it has ended
        with suppress(subprocess.TimeoutExpired):
            process.wait(_ENDS_WITHIN_S)
        process.kill()
        os.close(terminal_fd)
        cells.finish(process)
        watcher.join()
        os.close(keyboard_fd)

"""What the nursery's forks used, for tools/where_seconds_go.py: lines of JSON, as those of `time_account.py`."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kinds_of_time import Clocks


class ForkAccount:
    """That of one nursery: who asked for each fork, and what the system says of it at its end."""

    def __init__(self, folder: Path) -> None:
        self._file = os.open(folder / f"{os.getpid()}.jsonl", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self._askers: dict[socket.socket, int] = {}
        self._clocks = Clocks()
        self._clocks.install()

    def _write(self, what: str, **more: Any) -> None:
        os.write(self._file, (json.dumps({"what": what, **more}) + "\n").encode())

    def forked(self, pid: int, asking: socket.socket, line: socket.socket) -> None:
        """`asking` asked for it; what it will ask for comes along `line`."""
        if parent := self._askers.get(asking):
            self._write("fork", pid=pid, parent=parent)
        self._askers[line] = pid

    def bury(self, *_: object) -> None:
        """Wait for those that have ended; a handler of SIGCHLD."""
        try:
            while (ended := os.wait4(-1, os.WNOHANG))[0]:
                self._write("ended", pid=ended[0], cpu=ended[2].ru_utime + ended[2].ru_stime)
        except ChildProcessError:  # none is left
            return

    def of_fork(self) -> Callable[[], None]:
        """In a fork: what to call at its end."""
        self._clocks.take()
        return lambda: self._write("kinds of process", pid=os.getpid(), kinds=self._clocks.take())

    def close(self) -> None:
        """The nursery ends: what it used itself."""
        self.bury()
        self._write("nursery", pid=os.getpid(), cpu=time.process_time(), kinds=self._clocks.take())

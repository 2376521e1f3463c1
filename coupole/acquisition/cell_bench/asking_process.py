"""The process that asked a bench for work. The work lasts only while that process runs: a person who has ended or
stopped it (Ctrl-Z) believes that the arm does not move.
"""

from __future__ import annotations

import os
import select

from coupole.errors import InputError
from coupole.storage.stopped_process import is_stopped


class AskingProcess:
    """A process of this machine, as long as the context lasts."""

    def __init__(self, pid: int) -> None:
        """Raises InputError if the process has ended already. `pid` 0 is a process that this one cannot see, as
        one outside a container: it is not watched."""
        self._pid = pid
        try:
            self._process = os.pidfd_open(pid) if pid else -1
        except ProcessLookupError:
            raise InputError("the caller has ended: not begun") from None

    def __enter__(self) -> AskingProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process >= 0:
            os.close(self._process)

    def absence(self) -> str:
        """Return why the process does not run; empty if it runs."""
        if self._process < 0:
            return ""
        if select.select([self._process], [], [], 0)[0]:
            return f"process {self._pid}, which asked for it, has ended"
        if is_stopped(self._pid):
            return f"process {self._pid}, which asked for it, was stopped (Ctrl-Z, SIGSTOP)"
        return ""

"""Loan of the cell to one process of the service's user at a time, for work that needs no run."""

from __future__ import annotations

import os
import select
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

from coupole.errors import InputError


def begun_here(pid: int) -> bool:
    """Tell whether this process has begun process `pid`."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return int(stat.rpartition(")")[2].split()[1]) == os.getpid()


@dataclass(frozen=True)
class _Loan:
    pid: int
    process: int
    """A file descriptor of the process, which becomes readable when the process ends. A process id would not
    suffice, because ids are used again."""
    words: str


class Lending:
    """The present loan, if there is one. It ends when the process gives the cell back, or ends."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._loan: _Loan | None = None

    @property
    def lent_to(self) -> str:
        """Name of the borrower of the cell, and the purpose; empty if it is not lent."""
        with self._lock:
            if self._loan is not None and select.select([self._loan.process], [], [], 0)[0]:
                self._end()
            return self._loan.words if self._loan else ""

    def has(self, pid: int) -> bool:
        """Tell whether the cell is lent to the process `pid`."""
        with self._lock:
            return bool(self.lent_to) and self._loan is not None and self._loan.pid == pid

    def lend(self, pid: int, borrower: str, purpose: str) -> None:
        """Lend the cell to process `pid`. Raises InputError if it is lent already, or if there is no such
        process."""
        with self._lock:
            if self.lent_to:
                raise InputError(f"the cell is lent to {self.lent_to}")
            try:
                process = os.pidfd_open(pid)
            except OSError as error:
                raise InputError(f"process {pid}: {error.strerror}") from error
            self._loan = _Loan(pid, process, f"{borrower}: {purpose}")

    def interrupt(self) -> None:
        """Interrupt the borrower as by Ctrl-C. Raises InputError if the cell is not lent."""
        with self._lock:
            if not self.lent_to or self._loan is None:
                raise InputError("the cell is not lent")
            signal.pidfd_send_signal(self._loan.process, signal.SIGINT)

    def give_back(self, pid: int) -> None:
        """End the loan. Raises InputError if this process has not borrowed the cell."""
        with self._lock:
            if self._loan is None or self._loan.pid != pid:
                raise InputError("the cell is not lent to this process")
            self._end()

    def _end(self) -> None:
        assert self._loan is not None
        os.close(self._loan.process)
        self._loan = None

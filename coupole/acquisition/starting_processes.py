"""Processes of this user that have just been started to hold a cell, and cannot be asked yet: Python still loads
its modules. They are known only by their command lines."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from coupole.acquisition.sessions_without_run import socket_of

YOUNG_S = 20.0
"""A process without a socket that is older than this, s, is not starting: it needs no socket. A busy machine loads
the modules in 5 s."""
_HOLD = {"acquire", "demo", "commission", "meter", "live", "bench", "arm", "devices"}
_MODULES = {"coupole", "coupole.commands.cli"}
"""Modules that a Python process may run as the command line."""


@dataclass(frozen=True)
class StartingProcess:
    """A process whose command will hold a cell."""

    pid: int
    words: tuple[str, ...]
    """Its command and arguments."""
    folder: Path
    """Its working folder."""

    @property
    def name(self) -> str:
        """The command line and the process, in words."""
        return f"`{' '.join(('coupole', *self.words))}` (process {self.pid})"

    def names(self, file: Path) -> bool:
        """Tell whether an argument is this file."""
        path = str(file.resolve())
        return any(path == str((self.folder / word).resolve()) for word in self.words[1:])


def starting_processes() -> Iterator[StartingProcess]:
    """Yield the processes of this user that are starting."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            if entry.stat().st_uid != os.getuid():
                continue
            words = _words_after_coupole((entry / "cmdline").read_bytes().split(b"\0")[:-1])
            if _holds_a_cell(words) and _age_s(entry) < YOUNG_S and not socket_of(int(entry.name)).exists():
                yield StartingProcess(int(entry.name), words, (entry / "cwd").resolve(strict=True))
        except (OSError, ValueError, IndexError):  # it has ended
            continue


def _words_after_coupole(line: list[bytes]) -> tuple[str, ...]:
    """Return the words after the program's name; none if it is another program."""
    words = [os.fsdecode(word) for word in line]
    if words and Path(words[0]).name.startswith("python"):
        words = words[1:]
        while words and words[0].startswith("-") and words[0] != "-m":
            words = words[1:]
        if words[:1] == ["-m"] and words[1] in _MODULES:
            return tuple(words[2:])
    return tuple(words[1:]) if words and Path(words[0]).name == "coupole" else ()


def _holds_a_cell(words: tuple[str, ...]) -> bool:
    return bool(words) and (words[0] in _HOLD or words[:2] == ("calibrate", "all"))


def _age_s(process: Path) -> float:
    """Return the time since a process was begun, s."""
    fields = (process / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    begun_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - begun_s

"""The process that asked a bench for work. The work lasts only while that process runs: a person who has ended or
stopped it (Ctrl-Z) believes that the arm does not move.
"""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from coupole.storage.stopped_process import is_stopped

_LOOK_EVERY_S = 0.02


@contextmanager
def watched_process(pid: int, lose: Callable[[str], None]) -> Iterator[None]:
    """Call `lose` with the reason, from another thread, if a process of this machine ends or is stopped while the
    context lasts, or if it cannot be watched. `pid` 0 is a process that this one cannot see, for example outside a
    container. It is not watched. Raises RuntimeError if no thread can be begun."""
    over = threading.Event()
    if pid:
        threading.Thread(target=_watch, args=(pid, lose, over), name="asking process", daemon=True).start()
    try:
        yield
    finally:
        over.set()


def _watch(pid: int, lose: Callable[[str], None], over: threading.Event) -> None:
    try:
        process = os.pidfd_open(pid)  # the number may be used again
        try:
            end = select.poll()
            end.register(process, select.POLLIN)
            while not over.wait(_LOOK_EVERY_S):
                if end.poll(0):
                    raise ProcessLookupError
                if is_stopped(pid):
                    return lose(f"process {pid}, which asked for it, was stopped (Ctrl-Z, SIGSTOP)")
        finally:
            os.close(process)
    except ProcessLookupError:
        lose(f"process {pid}, which asked for it, has ended")
    except OSError as error:
        lose(f"process {pid}, which asked for it, cannot be watched: {error.strerror}")

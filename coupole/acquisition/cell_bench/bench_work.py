"""Work that takes a bench some time. One piece of work runs at a time, in a thread of its own; any thread can stop
it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from typing import Any

from coupole.acquisition.cell_bench.asking_process import watched_process
from coupole.acquisition.observer import Control
from coupole.errors import CoupoleError, InputError, Interrupted


class Work:
    """One piece of work, and its outcome."""

    def __init__(
        self, session: Control, kind: str, about: dict[str, Any], act: Callable[[Control], dict[str, Any]]
    ) -> None:
        """`act` does the work and returns its results. It raises Interrupted when its own Control or the session's
        Control is stopped."""
        self.kind, self._about, self._act = kind, about, act
        self.control = Control(session=session)
        self._state, self._found, self._why = "running", {}, ""  # type: tuple[str, dict[str, Any], str]
        self._asking_pid, self._lost = 0, ""
        self._thread = threading.Thread(target=self._run, name=kind, daemon=True)

    @property
    def is_running(self) -> bool:
        return self._state == "running"

    def begin(self, asking_pid: int) -> None:
        """Begin the work. It is stopped when the process that asked for it no longer runs (`watched_process`)."""
        self._asking_pid = asking_pid
        self._thread.start()

    def stop(self, why: str = "") -> None:
        """Stop the work. Returns at once; nothing new is moved or lit after this. The first `why` is reported to
        the process that requested the work."""
        self._lost = self._lost or why
        self.control.stop_by(signal.SIGINT)

    def join(self, seconds: float) -> None:
        self._thread.join(seconds)

    def figures(self) -> dict[str, Any]:
        """Return `kind`, `state` (running, done, stopped, failed), the request, the results, and `why` the work
        ended early."""
        return {"kind": self.kind, "state": self._state, **self._about, **self._found, "why": self._why}

    def _run(self) -> None:
        try:
            with watched_process(self._asking_pid, self.stop):
                self._found = self._act(self.control)
        except Interrupted as error:
            self._why = self._lost or str(error)
            self._state = "stopped"
        except CoupoleError as error:
            self._why = f"{self._lost}; {error}" if self._lost else str(error)
            self._state = "stopped" if self.control.stop.is_set() else "failed"
        except Exception as error:  # noqa: BLE001  told to whoever asks; the bench itself goes on
            self._why = f"{type(error).__name__}: {error}"
            self._state = "failed"
        else:
            self._state = "done"


class Works:
    """The work under way, or the last one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.last: Work | None = None
        self.stops = 0
        """Number of stops that were requested."""

    def begin(self, work: Work, stops: int, asking_pid: int = 0) -> None:
        """Begin the work. `stops` is the number of stops when the work was requested. The work is stopped when the
        process `asking_pid` no longer runs; 0: no process is watched. Raises InputError if a stop came since, or
        while other work is under way."""
        with self._lock:
            if self.stops != stops:
                raise InputError(f"{work.kind}: it was stopped before it began")
            self.refuse_beside()
            self.last = work
            work.begin(asking_pid)

    def refuse_beside(self) -> None:
        """Raise InputError if work is under way."""
        if (work := self.running) is not None:
            raise InputError(f"{work.kind} is under way; stop it or let it end")

    def stop(self, why: str = "") -> None:
        """Stop the work, for this reason. Returns at once. Work that was requested before and has not begun never
        begins."""
        with self._lock:
            self.stops += 1
            if self.last is not None:
                self.last.stop(why)

    @property
    def running(self) -> Work | None:
        last = self.last
        return last if last is not None and last.is_running else None

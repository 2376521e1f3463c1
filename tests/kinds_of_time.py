"""What a process spends its time on: imports, numba, starting processes and waiting for them, the browser,
Mitsuba.

Each moment is counted once: an import inside of numba's compiler is an import. CPU seconds are those of the
calling thread. Mitsuba has threads of its own: there, they are those of the process. Wall seconds are the main
thread's.
"""

from __future__ import annotations

import _frozen_importlib
import functools
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

IMPORTS, COMPILED, LOADED = "imports", "numba, compiling", "numba, loading"
STARTS, ENDS = "start of processes", "waiting for processes"
BROWSER, MITSUBA = "browser", "Mitsuba"


class Clocks:
    """CPU and wall seconds by kind, since the process began or `take()` was called."""

    def __init__(self) -> None:
        self.cpu_s: Counter[str] = Counter()
        self.wall_s: Counter[str] = Counter()
        self._threads = threading.local()
        self._main = threading.get_ident()
        self._known_libraries: set[str] = set()

    def install(self) -> None:
        """Begin to count, in this process."""
        from numba.core.dispatcher import Dispatcher

        _frozen_importlib._find_and_load = self.counted(IMPORTS, _frozen_importlib._find_and_load, self._known)
        Dispatcher.compile = self._numba(Dispatcher.compile)
        subprocess.Popen.__init__ = self.counted(STARTS, subprocess.Popen.__init__)  # type: ignore[method-assign]
        subprocess.Popen._wait = self.counted(ENDS, subprocess.Popen._wait)  # type: ignore[attr-defined]
        subprocess.Popen.communicate = self.counted(ENDS, subprocess.Popen.communicate)  # type: ignore[method-assign]

    def take(self) -> dict[str, dict[str, float]]:
        """What was counted since the last time."""
        cpu_s, wall_s = self.cpu_s, self.wall_s
        self.cpu_s, self.wall_s = Counter(), Counter()
        return {"cpu_s": dict(cpu_s), "wall_s": dict(wall_s)}

    def counted(
        self,
        kind: str,
        function: Callable[..., Any],
        afterwards: Callable[[], None] | None = None,
        cpu: Callable[[], float] = time.thread_time,
    ) -> Callable[..., Any]:
        """The function, whose time is of this kind."""

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            began = self._begin(cpu)
            try:
                return function(*args, **kwargs)
            finally:
                self._end(kind, began, cpu)
                if afterwards is not None:
                    afterwards()

        return timed

    def _begin(self, cpu: Callable[[], float]) -> tuple[float, float, list[float]]:
        inside = getattr(self._threads, "inside", None)
        self._threads.inside = [0.0, 0.0]
        return cpu(), time.perf_counter(), inside or [0.0, 0.0]

    def _end(self, kind: str, began: tuple[float, float, list[float]], cpu: Callable[[], float]) -> None:
        cpu_s, wall_s = cpu() - began[0], time.perf_counter() - began[1]
        inside, outside = self._threads.inside, began[2]
        self.cpu_s[kind] += max(0.0, cpu_s - inside[0])
        if threading.get_ident() == self._main:
            self.wall_s[kind] += max(0.0, wall_s - inside[1])
        self._threads.inside = [outside[0] + cpu_s, outside[1] + wall_s]

    def _numba(self, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def compiled(kernel: Any, *args: Any) -> Any:
            hits, began = sum(kernel._cache_hits.values()), self._begin(time.thread_time)
            try:
                return function(kernel, *args)
            finally:
                hit = sum(kernel._cache_hits.values()) > hits
                self._end(LOADED if hit else COMPILED, began, time.thread_time)

        return compiled

    def _known(self) -> None:
        """Libraries that have just been imported are timed from now on."""
        remote = sys.modules.get("selenium.webdriver.remote.remote_connection")
        if "browser" not in self._known_libraries and hasattr(remote, "RemoteConnection"):
            self._known_libraries.add("browser")
            remote.RemoteConnection.execute = self.counted(BROWSER, remote.RemoteConnection.execute)  # type: ignore[union-attr]
        mitsuba = sys.modules.get("mitsuba")
        if "mitsuba" not in self._known_libraries and hasattr(mitsuba, "set_variant"):
            self._known_libraries.add("mitsuba")
            self._time_mitsuba(mitsuba)

    def _time_mitsuba(self, mitsuba: Any) -> None:
        choose, sync = mitsuba.set_variant, sys.modules["drjit"].sync_thread

        def to_the_end(function: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(function)
            def ended(*args: Any, **kwargs: Any) -> Any:
                found = function(*args, **kwargs)
                sync()  # Dr.Jit's threads go on after the call
                return found

            return self.counted(MITSUBA, ended, cpu=time.process_time)

        def chosen(*names: str) -> None:
            choose(*names)
            for name in ("render", "load_dict"):
                function = getattr(mitsuba, name)
                if not hasattr(function, "__wrapped__"):
                    setattr(mitsuba, name, to_the_end(function))

        mitsuba.set_variant = self.counted(MITSUBA, chosen)

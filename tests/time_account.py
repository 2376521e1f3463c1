"""What each test spends, for tools/where_seconds_go.py: a line of JSON for each test, process and end of a worker.

A test's own CPU seconds are those of the tests' process from its set-up to its tear-down. A fixture that several
tests share counts for the first. The CPU seconds of a process are what `wait4` says at its end, with the
children that it waited for. They count for the test that started it, whenever it ends.
"""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from kinds_of_time import Clocks
from nursery import NURSERY, Born


class Account:
    """A plugin of pytest; one in each worker. Writes `folder`/<pid>.jsonl."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (folder / f"{os.getpid()}.jsonl").open("a", buffering=1)
        self._main = threading.get_native_id()
        self._test = ""
        self._clocks = Clocks()
        self._clocks.install()
        NURSERY.account = folder
        self._follow_processes()
        self._before = self._now()
        self._write("start", cpu_s=time.process_time())

    def _write(self, what: str, **more: Any) -> None:
        self._file.write(json.dumps({"what": what, "test": self._test, **more}) + "\n")

    def _now(self) -> tuple[float, float, float, float]:
        """Seconds: of the clock; of CPU, of the process and its main thread; that this one waited for a core."""
        waited_ns = int(Path(f"/proc/self/task/{self._main}/schedstat").read_text().split()[1])
        return time.perf_counter(), time.process_time(), time.thread_time(), waited_ns / 1e9

    def _account(self, what: str) -> None:
        now = self._now()
        wall_s, cpu_s, main_s, queued_s = (late - early for late, early in zip(now, self._before, strict=True))
        self._before = now
        self._write(what, wall=wall_s, cpu=cpu_s, main=main_s, queued=queued_s, kinds=self._clocks.take())

    def _follow_processes(self) -> None:
        """Have `Popen` tell what was started, and what it had used when it ended."""
        begin, forked, account = subprocess.Popen._execute_child, Born._execute_child, self  # type: ignore[attr-defined]

        def begun(process: subprocess.Popen[Any], arguments: Any, *options: Any) -> None:
            begin(process, arguments, *options)
            words = [arguments] if isinstance(arguments, (str, bytes)) else [*arguments]
            account._write("process", pid=process.pid, name=Path(os.fsdecode(words[0])).name)

        def born(process: Born, arguments: Any, *options: Any) -> None:
            forked(process, arguments, *options)
            account._write("process", pid=process.pid, name="command" if arguments else "world")

        def ended(process: subprocess.Popen[Any], flags: int) -> tuple[int, int]:
            try:
                pid, status, used = os.wait4(process.pid, flags)
            except ChildProcessError:
                return process.pid, 0
            if pid:
                account._write("ended", pid=pid, cpu=used.ru_utime + used.ru_stime)
            return pid, status

        subprocess.Popen._execute_child = begun  # type: ignore[attr-defined]
        subprocess.Popen._try_wait = ended  # type: ignore[attr-defined]
        Born._execute_child = born  # type: ignore[method-assign,assignment]

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_finish(self) -> None:
        self._account("collection")

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        self._account("between")
        self._test = item.nodeid
        result = yield
        self._account("test")
        self._test = ""
        return result

    def pytest_unconfigure(self) -> None:
        self._account("between")

"""A scheduler and workers of dask.distributed, each a process of its own, on this machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from places import REPO

_BEGINS_S = 60.0


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The scheduler's address, and the processes of its workers, of one thread each; all end with the context."""
    from distributed import Client  # here, as it takes a second to import and few tests need it

    told, log = folder / "scheduler.json", (folder / "dask.log").open("wb")
    environment = {**os.environ, "PYTHONPATH": f"{REPO}:{REPO / 'tests/reflectance'}"}

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", *arguments, "--scheduler-file", str(told), "--no-dashboard"]
        return subprocess.Popen(command, stdout=log, stderr=log, env=environment, cwd=folder)

    mine = [start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0")]
    try:
        _wait_for(told)
        worker = ("distributed.cli.dask_worker", "--nthreads", "1", "--no-nanny", "--memory-limit", "0")
        mine += [start(*worker, "--local-directory", str(folder / f"worker{n}")) for n in range(workers)]
        address = json.loads(told.read_text())["address"]
        with Client(address, set_as_default=False) as client:
            if workers:
                client.wait_for_workers(workers, timeout=_BEGINS_S)
        yield address, mine[1:]
    finally:
        for process in mine:
            process.kill()
            process.wait()
        log.close()


def _wait_for(path: Path) -> None:
    until_s = time.monotonic() + _BEGINS_S
    while not path.exists() or not path.read_text().strip().endswith("}"):
        assert time.monotonic() < until_s, "the scheduler has not begun"
        time.sleep(0.05)

"""Fits of the demo's samples by two workers of a dask cluster, each a process of one thread, against one worker.

The ratio of wall-clock seconds is meaningful only on two idle cores. CPU seconds are printed as well, because
other processes disturb them less: those of the calling process and of the busiest worker, with one worker and with
two.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from demo_plan import write_demo_plan

SMALLEST = {"kind": "every", "every": 40}
"""Lights of the smallest size; with fewer lights a fit has too few samples."""


@dataclass(frozen=True)
class Fitted:
    """Time that the fits took."""

    seconds: float
    client_cpu_s: float
    workers_cpu_s: tuple[float, ...]

    @property
    def cpu_s(self) -> float:
        """CPU seconds if the calling process and the worker compute one after the other."""
        return self.client_cpu_s + max(self.workers_cpu_s)


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    sys.path.append(str(root / "tests"))
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as name:
        folder = Path(name)
        plan = write_demo_plan(root, folder, lights=SMALLEST) if smallest else root / "configs/plans/demo.yaml"
        _coupole(root, "acquire", str(plan), "--yes", "--output", str(folder / "runs"))
        (run,) = (folder / "runs").glob("*demo")
        _coupole(root, "reflectance", "extract", str(run), "--out", str(folder / "samples"))
        fits_of: dict[int, list[Fitted]] = {1: [], 2: []}
        for number in range(rounds):
            for workers, fits in fits_of.items():
                fits.append(_fit(root, folder, workers, number))
        _refuse_others(folder / "by-1", folder / "by-2")
    seconds, cpu_s = ({n: statistics.median(getattr(fit, name) for fit in fits) for n, fits in fits_of.items()}
                      for name in ("seconds", "cpu_s"))  # fmt: skip
    last = fits_of[2][-1]
    yield {
        "name": "fits_by_two_workers",
        "value": seconds[2],
        "unit": "s",
        "peer": "one_worker",
        "ratio": seconds[1] / seconds[2],
        "ratio_of_cpu": round(cpu_s[1] / cpu_s[2], 3),
        "client_cpu_s": round(last.client_cpu_s, 2),
        "worker_cpu_s": [round(fit, 2) for fit in last.workers_cpu_s],
        "cores": len(os.sched_getaffinity(0)),
    }


def _coupole(root: Path, *arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "coupole", *arguments], check=True, cwd=root, capture_output=True)


def _fit(root: Path, folder: Path, workers: int, number: int) -> Fitted:
    from dask_cluster import cluster

    out, dask = folder / f"by-{workers}", folder / f"dask-{workers}-{number}"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(folder / "samples", out)
    dask.mkdir()
    with cluster(dask, workers) as (address, processes):
        used_s = [_cpu_s(process.pid) for process in processes]
        begun_s = time.perf_counter()
        command = [sys.executable, "-m", "coupole", "reflectance", "fit", str(out)]
        with (dask / "client.log").open("wb") as log:
            client = subprocess.Popen([*command, "--scheduler", address], cwd=root, stdout=log, stderr=log)
        _, status, usage = os.wait4(client.pid, 0)
        seconds = time.perf_counter() - begun_s
        client.returncode = os.waitstatus_to_exitcode(status)
        if client.returncode:
            raise RuntimeError((dask / "client.log").read_text())
        workers_cpu_s = (_cpu_s(process.pid) - before for process, before in zip(processes, used_s, strict=True))
        return Fitted(seconds, usage.ru_utime + usage.ru_stime, tuple(workers_cpu_s))


def _cpu_s(pid: int) -> float:
    stat_fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(stat_fields[11]) + int(stat_fields[12])) / os.sysconf("SC_CLK_TCK")


def _refuse_others(first_path: Path, second_path: Path) -> None:
    """Raise RuntimeError if two files of fits or samples have different numbers."""
    for path in sorted(first_path.rglob("*.h5")):
        with h5py.File(path) as file, h5py.File(second_path / path.relative_to(first_path)) as its:
            if wrong := [key for key in file if file[key][()].tobytes() != its[key][()].tobytes()]:
                raise RuntimeError(f"{path.name}: two workers give another {wrong[0]} than one")

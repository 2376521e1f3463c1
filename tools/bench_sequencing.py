"""Bursts and runs of the demo's plan against the time of their tables.

A burst of all LEDs is measured from INITiate to the last proven frame; a run on the world's clock and on the
machine's; and views whose LEDs are chosen in the run, from the start of the first burst to the last choice.
"""

from __future__ import annotations

import json
import resource
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from demo_plan import write_demo_plan

_SMALL = {"lights": {"kind": "every", "every": 40}}
"""Changes of the demo's plan for the smallest size."""
_EXPOSURES_US = (8000, 30000)
"""Exposures of the views whose LEDs are chosen."""


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    yield from _of_all_leds(root, rounds, smallest=smallest)
    for exposure_us in _EXPOSURES_US:
        yield _of_chosen_leds(root, rounds, exposure_us, smallest=smallest)


@dataclass(frozen=True)
class _Acquired:
    """A run, and what it took."""

    run: Any
    outcome: Any
    burst_times_s: list[float]
    """Durations of the bursts on the world's clock."""
    machine_s: float
    cpu_s: float
    """CPU time of this process."""


def _acquire(root: Path, folder: Path, **changes: Any) -> _Acquired:
    """Acquire the demo's plan with changed entries."""
    from coupole.acquisition.opened_cell import open_cell
    from coupole.acquisition.recorder import RunRecorder
    from coupole.acquisition.run_description import about_run, metadata_of_views
    from coupole.acquisition.sequencer import Sequencer
    from coupole.preflight.job import read_job
    from coupole.storage.run import Run

    job = read_job(write_demo_plan(root, folder, **changes))
    with open_cell(job.cell, job=job) as cell:
        run = Run.create(folder, "bench", job.inputs, about_run(job, cell))
        recorder = RunRecorder(run, metadata_of_views(job, cell))
        sequencer = Sequencer(job, cell, recorder)
        started_s, used_s = time.perf_counter(), _cpu_s()
        outcome = sequencer.acquire()
        machine_s, used_s = time.perf_counter() - started_s, _cpu_s() - used_s
        recorder.close()
    return _Acquired(run, outcome, sequencer.burst_times_s, machine_s, used_s)


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def _of_all_leds(root: Path, rounds: int, *, smallest: bool) -> Iterator[dict[str, Any]]:
    runs = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(dir=root) as folder:
            runs.append(_acquire(root, Path(folder), **(_SMALL if smallest else {})))
            table_s, leds = _longest_table(runs[-1].run)
    burst_s = statistics.median(burst_s for run in runs for burst_s in run.burst_times_s)
    yield _figure(f"burst_{leds}_leds", burst_s, "s", table_s / burst_s)
    on_rig_clock = statistics.median(run.outcome.ideal_s / run.outcome.duration_s for run in runs)
    yield _figure("run_of_three_views", on_rig_clock, "1", on_rig_clock, peer="ideal_time")
    machine_s = statistics.median(run.machine_s for run in runs)
    yield _figure(
        "run_of_three_views_machine_time",
        machine_s,
        "s",
        runs[-1].outcome.ideal_s / machine_s,
        peer="ideal_time",
        cpu_ms_per_frame=round(1e3 * statistics.median(run.cpu_s / run.outcome.proven for run in runs), 3),
    )


def _of_chosen_leds(root: Path, rounds: int, exposure_us: int, *, smallest: bool) -> dict[str, Any]:
    first, burst, most = (8, 8, 24) if smallest else (64, 64, 384)
    lights = {"kind": "adaptive", "first_lights": first, "burst_lights": burst, "until": {"lights": most}}
    views: list[tuple[float, float]] = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(dir=root) as folder:
            exposure = {"kind": "fixed", "exposure_us": exposure_us}
            views += _times_of_views(_acquire(root, Path(folder), lights=lights, exposure=exposure).run)
    elapsed_s, tables_s = np.median(views, axis=0).tolist()
    return _figure(
        f"chosen_leds_{exposure_us}_us", elapsed_s, "s", tables_s / elapsed_s, leds=most, leds_per_burst=burst
    )


def _figure(
    name: str, value: float, unit: str, ratio: float, *, peer: str = "table_time", **more: Any
) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio, **more}


def _events(run: Any) -> Iterator[dict[str, Any]]:
    yield from map(json.loads, run.journal_path.read_text().splitlines())


def _longest_table(run: Any) -> tuple[float, int]:
    """Return the duration of the longest table, s, and the number of its LEDs."""
    seconds = max(event["table_s"] for event in _events(run) if event["event"] == "burst")
    first_view = run.views[0]
    return seconds, len({shot.label.light for shot in run.proven() if shot.view == first_view and shot.is_shot})


def _times_of_views(run: Any) -> Iterator[tuple[float, float]]:
    """Yield the seconds of each view's bursts, and of their tables."""
    begun_s: float | None = None
    tables_s = 0.0
    for event in _events(run):
        now_s = datetime.fromisoformat(event["t"]).timestamp()
        if event["event"] == "begin" and begun_s is None:
            begun_s, tables_s = now_s, 0.0
        elif event["event"] == "burst":
            tables_s += event["table_s"]
        elif event["event"] == "seal" and begun_s is not None:
            yield now_s - begun_s, tables_s
            begun_s = None

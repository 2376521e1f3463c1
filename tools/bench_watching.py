"""Cost of examining a full-size frame and of judging a burst, relative to the time of a frame at 100 frames/s."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from coupole.acquisition.watching.burst_judge import FirstFrames
from coupole.acquisition.watching.findings import SeenFrame
from coupole.acquisition.watching.frame_look import LookGrid, compile_now
from coupole.acquisition.watching.watched_run import judge_of
from coupole.devices import FrameFormat
from coupole.preflight.job import read_job
from demo_plan import write_demo_plan

FULL = FrameFormat(3072, 4096, 12, "GBRG", 64, 4095)
FRAME_MS = 10.0
BUFFERS = 8
"""Number of frames used in turn; they are larger than a cache."""


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """Yield figures of one thread; the ratio is a frame's time over the cost."""
    compile_now()
    random = np.random.default_rng(5)
    shape = (BUFFERS, FULL.height_px, FULL.width_px)
    frames = random.integers(64, 3000, shape, dtype=np.uint16)
    period = "frame_period_at_100_hz"
    for name, grid in (
        ("look_at_12_mp_frame_for_its_dark_frames", LookGrid(FULL, is_sparse=True)),
        ("look_at_12_mp_frame", LookGrid(FULL)),
    ):
        times_ms = []
        for turn in range(BUFFERS * (1 if smallest else 5 * rounds)):
            start = time.perf_counter()
            grid.look(frames[turn % BUFFERS])
            times_ms.append(1e3 * (time.perf_counter() - start))
        look_ms = statistics.median(times_ms)
        yield {"name": name, "value": look_ms, "unit": "ms", "peer": period, "ratio": FRAME_MS / look_ms}
    with tempfile.TemporaryDirectory() as folder:
        lights = {"kind": "every", "every": 20} if smallest else {"kind": "all"}
        job = read_job(write_demo_plan(root, Path(folder), watch=True, lights=lights))
    labels = [label for label in job.schedule.bursts[0][0].labels if label]
    looks = [grid.look(frame) for frame in frames]
    seen_frames = [SeenFrame(label, looks[place % BUFFERS]) for place, label in enumerate(labels)]
    start = time.perf_counter()
    judge_of(job, grid, job.schedule.views[0], FirstFrames()).judge(seen_frames, 8000)
    judge_ms = 1e3 * (time.perf_counter() - start) / len(seen_frames)
    yield {
        "name": f"judging_a_burst_of_{len(seen_frames)}_per_frame",
        "value": judge_ms,
        "unit": "ms",
        "peer": period,
        "ratio": FRAME_MS / judge_ms,
    }

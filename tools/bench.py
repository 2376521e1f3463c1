"""Benchmarks against peers, one JSON line each: `python tools/bench.py [check|sequencing|store|matching|rsi ...]`.

`--smallest` runs one round of each at a size of seconds. This shows only that the benchmark runs, not how fast
Coupole is.

Each line has `name`, `value`, `unit`, `peer` (a program measured in the same run, or the limit) and `ratio`
(Coupole's figure over the peer's; above 1 is better). Values are medians of interleaved rounds; ratios are given
because absolute times vary from machine to machine and from run to run.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smallest import add_smallest

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Asked:
    """The request: number of rounds, size of the measurement."""

    rounds: int
    frames: int | None
    """Number of frames of `reflectance`."""
    smallest: bool


def line(name: str, value: float, unit: str, peer: str, ratio: float, **more: Any) -> None:
    """Print one figure."""
    figure = {"name": name, "value": round(value, 6), "unit": unit, "peer": peer, "ratio": round(ratio, 4), **more}
    print(json.dumps(figure), flush=True)


# -- check ------------------------------------------------------------------------------------------------


def bench_check(options: Asked) -> None:
    """Measure `coupole check --no-paths` of 30 views x 1080 LEDs x 3 exposures, against the limit of 3 s, and
    against a Python process that only imports numpy, pydantic and h5py."""
    command = [
        sys.executable,
        "-m",
        "coupole",
        "check",
        str(ROOT / "configs/plans/large.yaml"),
        "--no-paths",
    ]
    bare = [sys.executable, "-c", "import numpy, pydantic, h5py"]
    times_s: list[float] = []
    peers: list[float] = []
    for _ in range(options.rounds):
        for argv, times in ((command, times_s), (bare, peers)):
            start = time.perf_counter()
            subprocess.run(argv, check=True, capture_output=True, cwd=ROOT)
            times.append(time.perf_counter() - start)
    value, peer = statistics.median(times_s), statistics.median(peers)
    line("check_large_plan", value, "s", "limit_3_s", 3.0 / value)
    line("check_large_plan", value, "s", "python_imports", peer / value)


# -- sequencing -------------------------------------------------------------------------------------------


def bench_sequencing(options: Asked) -> None:
    """Measure bursts and runs against the time of their tables."""
    from bench_sequencing import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


# -- store ------------------------------------------------------------------------------------------------


def bench_store(options: Asked) -> None:
    """Measure the writing of full-size frames to disk: the view writer and others, and the whole data path of a
    run."""
    from bench_store import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


# -- live -------------------------------------------------------------------------------------------------


def bench_live(options: Asked) -> None:
    """Measure whole runs of full-size frames with simultaneous processing, against the same runs without it."""
    from bench_live import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


# -- matching ---------------------------------------------------------------------------------------------


def bench_matching(options: Asked) -> None:
    """Measure the proof of a whole burst of 1092 frames, 2 % of them lost. The peers are numpy's nearest-neighbour
    pairing, which gets the clocks' offset and proves nothing, and the 10 ms of a frame at 100 frames/s."""
    from coupole.acquisition.frame_matching import compile_now, match
    from coupole.devices import STEP_RECORD_DTYPE
    from coupole.preflight.job import read_job

    compile_now()
    table = read_job(ROOT / "configs/plans/demo.yaml").schedule.bursts[0][0].table
    log = np.zeros(len(table), STEP_RECORD_DTYPE)
    log["step"], log["led"], log["edge_sent"] = np.arange(len(table)), table["led"], True
    log["t_trigger_ns"] = 1_000_000 + 1000 * np.concatenate([[0], np.cumsum(table["period_us"][:-1])])
    random = np.random.default_rng(7)
    here = random.random(len(log)) > 0.02
    stamps = (log["t_trigger_ns"] * (1 + 3e-5) + 5e9).astype(np.int64)
    frame_ids, stamps = (np.arange(len(log)) + 1)[here], stamps[here]
    times_s: list[float] = []
    peers: list[float] = []

    def pair() -> None:
        nearest = np.searchsorted(log["t_trigger_ns"], stamps - 5_000_000_000)
        nearest.clip(0, len(log) - 1)

    def prove() -> None:
        matching = match(log, frame_ids, stamps, complete=True)
        assert np.count_nonzero(matching.step_of_frame >= 0) == len(frame_ids)

    for _ in range(2 if options.smallest else max(options.rounds, 3) * 20):
        for work, times in ((prove, times_s), (pair, peers)):
            start = time.perf_counter()
            work()
            times.append((time.perf_counter() - start) / len(frame_ids) * 1e6)
    value, peer = statistics.median(times_s), statistics.median(peers)
    line("matching_per_frame", value, "us", "frame_period_at_100_hz", 10_000 / value)
    line("matching_per_frame", value, "us", "numpy_nearest_pairing", peer / value, peer_value=round(peer, 4))


# -- robot and collisions: in separate files ------------------------------------------------------------------


def bench_rsi(options: Asked) -> None:
    """Measure the latency of answers to a KUKA controller at 4 ms, against a minimal program in C."""
    from bench_rsi import figures

    for figure in figures(options.rounds, smallest=options.smallest):
        line(**figure)


def bench_collisions(options: Asked) -> None:
    """Measure the collision check of one pose of the arm, against python-fcl."""
    from bench_collisions import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_archive(options: Asked) -> None:
    """Measure compression ratio and speed of archiving a view, and of reading from it. The peers are h5py and the
    file before archiving."""
    from bench_archive import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_codecs(options: Asked) -> None:
    """Compare packing, compression and Exif with libraries that have the same functions: equality of output, and
    speed."""
    from bench_codecs import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_mesh(options: Asked) -> None:
    """Measure the reading of a scan of 10 million triangles against numpy and trimesh, and the memory for 40
    million."""
    from bench_mesh import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_calibration(options: Asked) -> None:
    """Measure the search for a board and the adjustments of hand-eye and LEDs, against plain use of OpenCV and
    scipy."""
    from bench_calibration import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_render(options: Asked) -> None:
    """Measure pictures of the simulated dome, against Open3D, Embree and Mitsuba, and the memory for a large
    scan."""
    from bench_render import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_reflectance(options: Asked) -> None:
    """Measure the steps from frames to samples, fits and relit pictures, against the disk, BLAS, SciPy, Mitsuba
    and published figures. This takes 12 GB of disk and some minutes; `--frames` makes it smaller."""
    from bench_reflectance import figures

    for figure in figures(ROOT, options.rounds, options.frames, smallest=options.smallest):
        line(**figure)


def bench_console(options: Asked) -> None:
    """Measure the demo's efficiency while ten people watch it at a console, against that without watchers. It
    needs an idle machine."""
    from bench_console import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_workers(options: Asked) -> None:
    """Measure fits of the demo's samples by two workers of a cluster, against one. It needs two idle cores. It
    acquires the demo first, and takes 3 GB of disk."""
    from bench_workers import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_urushi(options: Asked) -> None:
    """Measure sphere maps of gold under ten lights, computed again for each position of the lights."""
    from bench_urushi import figures

    for figure in figures(options.rounds, smallest=options.smallest):
        line(**figure)


def bench_watching(options: Asked) -> None:
    """Measure the examination of a full-size frame and the judgement of a burst, against a frame's time at 100
    frames/s."""
    from bench_watching import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


def bench_page(options: Asked) -> None:
    """The page of 9 million texels on the software renderer: its first picture against 3 s, and pictures while
    the object is turned against 15 a second."""
    from bench_page import figures

    for figure in figures(ROOT, options.rounds, smallest=options.smallest):
        line(**figure)


BENCHES: dict[str, Callable[[Asked], None]] = {
    "check": bench_check,
    "sequencing": bench_sequencing,
    "store": bench_store,
    "live": bench_live,
    "matching": bench_matching,
    "rsi": bench_rsi,
    "collisions": bench_collisions,
    "archive": bench_archive,
    "codecs": bench_codecs,
    "render": bench_render,
    "mesh": bench_mesh,
    "calibration": bench_calibration,
    "reflectance": bench_reflectance,
    "urushi": bench_urushi,
    "workers": bench_workers,
    "console": bench_console,
    "watching": bench_watching,
    "page": bench_page,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which of {', '.join(BENCHES)}; all if none")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--frames", type=int, help="of `reflectance`; 300 by itself")
    add_smallest(parser, rounds=1)
    parser.add_argument("--json", action="store_true", help="accepted for uniformity: the lines are always JSON")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(BENCHES):
        parser.error(f"expected some of {', '.join(BENCHES)}; found {', '.join(sorted(unknown))}")
    request = Asked(arguments.rounds, arguments.frames, arguments.smallest)
    for name in arguments.names or BENCHES:
        BENCHES[name](request)


if __name__ == "__main__":
    main()
